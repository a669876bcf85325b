"""What a prior knows of a keyframe's depths, kept with those that are triangulated."""

from __future__ import annotations

from collections.abc import Callable

from aquaflow.config.tracking import LearnedConfig
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.tracking.learned.scaling import LearnedDepth, learned_depth


def add_learned(
    pointmap: Pointmap,
    X: Float | None,  # [H, W, 3] in the pointmap's camera; NaN where unknown
    Q: Float | None,  # [H, W] 1 / relative variance; 0 where unknown
    known_sigma: float,
    config: LearnedConfig,
    unit: RangeUnit = "shared",
    before: Callable[[], Pointmap] | None = None,
) -> LearnedDepth | None:
    """Set what the prior knows of the picture in ``pointmap``, and return it; None, and no change,
    without ranges or a unit for them.

    The unit is that of the triangulated depths; where these are too few, because the camera only
    turned, that of what ``before`` gives: what the keyframe before had learned, seen from here.

    Both are kept, and no mean is taken of them: the network's error is that of a whole part of the
    picture, so that depths which are better one by one would all be moved the same way.
    """
    if not config.depth or X is None or Q is None:
        return None
    depth = learned_depth(pointmap, X, Q, known_sigma, unit)
    if depth is None and before is not None:
        depth = learned_depth(before(), X, Q, known_sigma, unit)
    if depth is not None:
        pointmap.learned = depth.kept
    return depth
