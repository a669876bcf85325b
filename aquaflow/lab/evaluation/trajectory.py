"""Trajectories of different sources, associated by time."""

from aquaflow.dive.tum import ASSOCIATION_TOLERANCE_S, Trajectory, associate, read_tum

__all__ = ["ASSOCIATION_TOLERANCE_S", "Trajectory", "associate", "read_tum"]
