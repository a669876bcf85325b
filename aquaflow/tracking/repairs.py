"""Repairs of a keyframe that the monitor found inconsistent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.consistency import (
    Cause,
    ConsistencyMonitor,
    InconsistentKeyframe,
    depth_ratio,
)
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.frames import Revisit
from aquaflow.tracking.pose.depth_fusion import MOST_FUSED
from aquaflow.tracking.pose.matcher import Matched, sample

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


# --------------------------------------------------------------------------------------------------
# Two keyframes joined by a frame that was matched to both: an edge for the keyframe graph.

RATIO_POINTS = 500
"""Points whose depths are compared to join two keyframes."""
KNOWN_SIGMA = 0.05
"""Relative sigma of depths that are compared."""
LEAST_SCALE_SIGMA = 0.005
"""Relative; as much as a link along the path may lose (``LINK_SCALE_SIGMA`` of tracking/graph)."""


def find_revisit(
    at: CurrentKeyframe,
    solved: Matched,
    back: CurrentKeyframe,
    solved_back: Matched,
    pointmap: Pointmap,
) -> Revisit | None:
    """Pose and scale of the keyframe ``at`` seen from that of ``back``, through the last frame.

    ``pointmap``: the frame's depths in the unit of ``at``; None where too few of them are known.
    """
    earlier = back.keyframe.pointmap
    points = sample(earlier, earlier.is_known(KNOWN_SIGMA), RATIO_POINTS)[2]
    ratio = depth_ratio(points, solved_back.estimate.T, pointmap, KNOWN_SIGMA)
    if ratio is None:
        return None
    unit = Sim3(np.eye(3), np.zeros(3), float(np.exp(ratio.log)))
    T_ke = solved.estimate.T.inverse() @ unit @ solved_back.estimate.T
    covariance = solved_back.estimate.covariance[:6, :6] + solved.estimate.covariance[:6, :6]
    sigma = max(LEAST_SCALE_SIGMA, ratio.sigma)
    return Revisit(at.keyframe.number, back.keyframe.number, T_ke, covariance, sigma)
