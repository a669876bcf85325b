"""Repairs of a keyframe that the monitor found inconsistent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.consistency import Cause, ConsistencyMonitor, InconsistentKeyframe
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.frames import Revisit
from aquaflow.tracking.pose.depth_fusion import MOST_FUSED
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.tracking.revisits import find_revisit

DOUBT = 0.05
"""Relative sigma of depths that are to be triangulated anew, at least: three frames outweigh it."""


@dataclass(frozen=True)
class LastFrame:
    """The frame at which something was found, and its pose at the keyframe in use."""

    encoding: Encoding
    camera: CameraModel
    solved: Matched


@dataclass(frozen=True)
class Repaired:
    """How tracking goes on."""

    at: CurrentKeyframe
    revisit: Revisit | None = None
    """For the graph: the keyframe that was left, seen from the one that tracking went on at."""


class Repairs:
    """Brings depths back to their scale, has them triangulated anew, or goes on at an earlier
    keyframe of the place."""

    def __init__(self, monitor: ConsistencyMonitor, keyframe_tracker: KeyframeTracker) -> None:
        self._monitor, self._keyframe_tracker = monitor, keyframe_tracker
        self._doubted: set[int] = set()
        """Numbers of the keyframes that were triangulated anew once: it need not help."""

    def __call__(
        self, finding: InconsistentKeyframe, at: CurrentKeyframe, frame: LastFrame
    ) -> Repaired | None:
        """None if nothing could be done."""
        counts = self._monitor.counts
        if finding.cause is Cause.DEPTHS:
            rescale(at, finding.ratio)
            counts.rescaled += 1
            return Repaired(at)
        if finding.cause is Cause.MATCHES:
            again = at.keyframe.number in self._doubted
            self._doubted.add(at.keyframe.number)
            doubt(at.keyframe.pointmap)
            counts.refused += 1
            return self._elsewhere(at, frame, aside=again) or Repaired(at)
        found = self._elsewhere(at, frame, aside=True)
        counts.unrepaired += found is None
        return found

    def _elsewhere(self, at: CurrentKeyframe, frame: LastFrame, aside: bool) -> Repaired | None:
        """At an earlier keyframe; the one in use is put ``aside``: it is returned to no more."""
        tracker = self._keyframe_tracker
        for neighbour, _ in self._monitor.witnesses(at.keyframe):
            back = tracker.back_at(neighbour, at, frame.encoding, frame.camera, drifted=True)
            if back is None or not self._fits(back[1]):
                continue
            revisit = None
            if aside:
                pointmap, _ = tracker.pointmap(at, frame.solved, frame.camera)
                revisit = find_revisit(at, frame.solved, back[0], back[1], pointmap)
                tracker.neighbours.set_aside(at.keyframe)
            tracker.take_up(back[0])
            self._monitor.counts.relocalised += 1
            return Repaired(back[0], revisit)
        return None

    def _fits(self, solved: Matched) -> bool:
        share = solved.estimate.inlier_share
        return self._keyframe_tracker.shows(solved) and share >= self._monitor.least_inliers


def rescale(at: CurrentKeyframe, ratio: float) -> None:
    """Divide the depths of the keyframe in use by ``ratio``, in place, and fuse no more into them.

    Poses take their scale from these depths: triangulated anew, they would drift again (at 112 px
    by 2 to 8 % within ten frames).
    """
    pointmap = at.keyframe.pointmap
    known = pointmap.is_known(1.0)
    pointmap.rho *= ratio
    pointmap.variance[known] *= ratio**2
    pointmap.fused = MOST_FUSED
    pointmap.learned = None  # of the unit as it was
    at.T_fk = Sim3(at.T_fk.R, at.T_fk.t / ratio, at.T_fk.scale)
    at.motion = Sim3(at.motion.R, at.motion.t / ratio, at.motion.scale)


def doubt(pointmap: Pointmap) -> None:
    """Let the next frames' depths replace those of ``pointmap``, which stay known until then."""
    known = pointmap.is_known(1.0)
    least = (DOUBT * pointmap.rho) ** 2
    pointmap.variance[known] = np.maximum(pointmap.variance, least)[known]
    pointmap.fused = 0
