"""Luxonis OAK cameras: policy here, the vendor's library behind a thin protocol."""

from drivers.oak.camera import OakCamera

__all__ = ["OakCamera"]
