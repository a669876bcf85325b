"""The method: one frame's way through tracking and mapping (:class:`~aquaflow.slam.slam.Slam`)."""

from aquaflow.slam.slam import Slam

__all__ = ["Slam"]
