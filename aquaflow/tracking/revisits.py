"""Two keyframes joined by a frame that was matched to both: an edge for the keyframe graph."""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.current_keyframe import CurrentKeyframe
from aquaflow.tracking.depth_ratio import depth_ratio
from aquaflow.tracking.frames import Revisit
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.tracking.pose.visibility import sample

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
