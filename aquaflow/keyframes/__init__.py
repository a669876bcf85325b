"""Keyframes and their fused pointmaps: what tracking and mapping share."""

from aquaflow.keyframes.place import UNKNOWN_VARIANCE, LearnedDepths, Pointmap
from aquaflow.keyframes.store import RESIDENT_KEYFRAMES, Keyframe, KeyframeStore

__all__ = [
    "RESIDENT_KEYFRAMES",
    "UNKNOWN_VARIANCE",
    "Keyframe",
    "KeyframeStore",
    "LearnedDepths",
    "Pointmap",
]
