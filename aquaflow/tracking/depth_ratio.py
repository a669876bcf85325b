"""Do two pointmaps agree about how far the scene is? Points of one, looked up in the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.optimise.robust import sigma_of

Array = npt.NDArray[np.float64]

MIN_POINTS = 16
"""Points in common below which nothing is said: a quarter of a sketch."""
MEDIAN = 1.2533
"""Standard deviation of a median over that of a mean."""


@dataclass(frozen=True)
class DepthRatio:
    """How much further a pointmap has the scene than other points say."""

    log: float
    """Median of log (depth in the pointmap / depth of the points)."""
    sigma: float
    """Standard deviation of that median, from the spread."""
    points: int


def depth_ratio(
    points: Array,  # [M, 3] in any frame
    T_kp: Sim3,
    pointmap: Pointmap,
    known_sigma: float,
) -> DepthRatio | None:
    """Depths of ``pointmap`` against those of ``points``, which ``T_kp`` takes to its keyframe;
    None where it shows too few of them."""
    X = T_kp.apply(points)
    X = X[X[:, 2] > 1e-6]
    camera = pointmap.camera
    pixels = camera.project(X)
    inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(-1)
    X, (u, v) = X[inside], np.floor(pixels[inside]).astype(np.intp).T
    rho, variance = pointmap.rho[v, u], pointmap.variance[v, u]
    known = (rho > 1e-6) & (variance < (known_sigma * rho) ** 2)
    if known.sum() < MIN_POINTS:
        return None
    logs = -np.log(X[known, 2] * rho[known])
    middle = float(np.median(logs))
    spread = sigma_of(logs - middle)
    count = len(logs)
    return DepthRatio(middle, MEDIAN * spread / float(np.sqrt(count)), count)
