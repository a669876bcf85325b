"""Learned depths in a keyframe's pointmap, with those that were triangulated (paper: X and Q)."""

from __future__ import annotations

import numpy as np

from aquaflow.config.tracking import LearnedConfig
from aquaflow.keyframes import UNKNOWN_VARIANCE, Pointmap
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.tracking.learned.scaling import LearnedDepth, learned_depth


def add_learned(
    pointmap: Pointmap,
    X: Float | None,  # [H, W, 3] in the pointmap's camera; NaN where unknown
    Q: Float | None,  # [H, W] 1 / relative variance; 0 where unknown
    known_sigma: float,
    config: LearnedConfig,
    unit: RangeUnit = "shared",
) -> LearnedDepth | None:
    """Fuse what the prior knows of the picture into ``pointmap`` (in place); returns that in the
    pointmap's unit. None, and no change, without ranges or a unit for them."""
    if not config.depth or X is None or Q is None:
        return None
    depth = learned_depth(pointmap, X, Q, known_sigma, unit)
    if depth is not None:
        fuse_learned(pointmap, depth)
        if unit == "shared":  # any other is of no meaning in the next keyframe
            pointmap.learned_scale = (depth.log_scale, depth.log_scale_sigma)
    return depth


def fuse_learned(pointmap: Pointmap, depth: LearnedDepth) -> None:
    """Take the learned depth (in place) where none was triangulated, or with a larger variance.

    No mean is taken of the two: the network's error is that of a whole part of the picture, so
    that depths which are better one by one would all be moved the same way.
    """
    rho, variance = pointmap.rho, pointmap.variance
    triangulated = (rho > 1e-6) & (variance < UNKNOWN_VARIANCE)
    learned = np.where(depth.known, depth.variance, 0.0) * depth.rho**2
    take = depth.known & (~triangulated | (learned < variance))
    rho[take], variance[take] = depth.rho[take], learned[take]
    pointmap.learned = take if pointmap.learned is None else pointmap.learned | take
