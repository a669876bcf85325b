"""Poses against keyframes: a frame follows its keyframe through every later correction."""

from __future__ import annotations

from dataclasses import dataclass, replace

from aquaflow.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking.frames import Tracked


@dataclass(frozen=True)
class Anchored:
    """A tracked frame with its pose against its keyframe, which later corrections leave."""

    tracked: Tracked
    T_kf: Sim3 | None = None
    """None for a frame without a pose."""


class Anchors:
    """Computes both poses, the one against the keyframe and the one in the world, from the other.

    A frame for which that fails is lost, and counted in ``failures``.
    """

    def __init__(self, keyframes: KeyframeStore, failures: Failures) -> None:
        self._keyframes, self._failures = keyframes, failures

    def anchored(self, tracked: Tracked) -> Anchored:
        """The frame as tracking placed it, with its pose against its keyframe."""
        if tracked.keyframe is None or tracked.T_wc is None:
            return Anchored(tracked)
        with self._failures.contain("pose", tracked.frame.index):
            T_kf = self._keyframes[tracked.keyframe].T_wc.inverse() @ tracked.T_wc
            return Anchored(tracked, T_kf.if_finite())
        return Anchored(self._lost(tracked))

    def settled(self, tracked: Tracked, T_kf: Sim3 | None) -> Tracked:
        """The frame with pose and sub-map as its keyframe's are now; lost if that has no pose."""
        if tracked.keyframe is None or T_kf is None:
            return tracked
        keyframe = self._keyframes[tracked.keyframe]
        with self._failures.contain("pose", tracked.frame.index):
            T_wc = (keyframe.T_wc @ T_kf).if_finite()
            return replace(tracked, T_wc=T_wc, sub_map=keyframe.sub_map)
        return self._lost(tracked)

    def _lost(self, tracked: Tracked) -> Tracked:
        reason = self._failures.reason(tracked.frame.index) or "tracking failed"
        return Tracked.lost(tracked.frame, tracked.sub_map, reason)
