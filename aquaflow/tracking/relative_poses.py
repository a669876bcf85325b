"""Poses relative to keyframes: a frame moves with its keyframe in every later correction."""

from __future__ import annotations

from dataclasses import dataclass, replace

from aquaflow.base.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking.frames import Tracked


@dataclass(frozen=True)
class RelativeFrame:
    """A tracked frame with its pose relative to its keyframe, unchanged by later corrections."""

    tracked: Tracked
    T_kf: Sim3 | None = None
    """None for a frame without a pose."""


class RelativePoses:
    """Computes a frame's pose relative to its keyframe from its pose in the world, and back.

    A frame for which this fails is lost, and counted in ``failures``.
    """

    def __init__(self, keyframes: KeyframeStore, failures: Failures) -> None:
        self._keyframes, self._failures = keyframes, failures

    def relative_pose(self, tracked: Tracked) -> RelativeFrame:
        """The frame as tracked, with its pose relative to its keyframe."""
        if tracked.keyframe is None or tracked.T_wc is None:
            return RelativeFrame(tracked)
        with self._failures.contain("pose", tracked.frame.index):
            T_kf = self._keyframes[tracked.keyframe].T_wc.inverse() @ tracked.T_wc
            return RelativeFrame(tracked, T_kf.if_finite())
        return RelativeFrame(self._lost_frame(tracked))

    def world_pose(self, tracked: Tracked, T_kf: Sim3 | None) -> Tracked:
        """The frame with the pose and sub-map that its keyframe gives it now; lost if none."""
        if tracked.keyframe is None or T_kf is None:
            return tracked
        keyframe = self._keyframes[tracked.keyframe]
        with self._failures.contain("pose", tracked.frame.index):
            T_wc = (keyframe.T_wc @ T_kf).if_finite()
            return replace(tracked, T_wc=T_wc, sub_map=keyframe.sub_map)
        return self._lost_frame(tracked)

    def _lost_frame(self, tracked: Tracked) -> Tracked:
        reason = self._failures.reason(tracked.frame.index) or "tracking failed"
        return Tracked.as_lost(tracked.frame, tracked.sub_map, reason)
