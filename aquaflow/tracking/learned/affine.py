"""The shift of inverse depths that a network knows up to scale and shift only.

Such a network's inverse depth is d = g rho + c of the true one, rho. Where the keyframe's depths
are triangulated, c is found by a robust line; then 1 / (d - c) is a depth of unknown unit, as other
networks have it (scaling.py), which also finds what is left of the shift's error. The line is that
of d over rho: rho has the smaller errors, and errors of what a line is over make it too flat.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.least_squares import RobustFit, Rules, covariance_of, minimise
from aquaflow.optimise.robust import Tukey

Array = npt.NDArray[np.float64]

LAGS = (2, 3, 5, 7)
"""Pixels are paired with those this part of the list further on: slopes of such pairs, not of
neighbours, whose errors are alike."""
LEAST_SPREAD = 0.25
"""Difference of d within a pair, over the standard deviation of all, from which it has a slope."""
MOST_ERROR = 0.1
"""Standard error of the shift over the median of d - c beyond which it is not known: depths half as
large and twice as large as the median's are then 5 and 20 % off."""
INDEPENDENT = 48
"""Errors of a network that count as independent in a picture (8 x 6 cells), as those of matches
(tracking/pose/covariance.py)."""
RULES = Rules(iterations=12, sigmas=1e-2, damping=0.0)
"""Of reweighting; each iteration divides the remaining error by five or more."""
FARTHEST = 50.0
"""Depth over the median depth beyond which nothing is known: there the shift decides all."""


def shift_of(
    inverse: Array,  # [M] the network's inverse depths, d
    rho: Array,  # [M] the keyframe's
) -> float | None:
    """-c of d = g rho + c; None where d does not grow with rho, or the depths differ too little
    for the shift to be known."""
    slope = _slope_of_pairs(inverse, rho)
    if slope is None or slope <= 0.0:
        return None
    start = 1.0 / slope
    line = np.array([start, float(np.median(inverse - start * rho))])
    A = np.stack([np.ones_like(rho), 1.0 / rho], -1)  # divided by rho: errors are relative
    y = inverse / rho
    problem = RobustFit(
        residuals=lambda line: A @ line - y,
        jacobian=lambda line: A,
        kernel=Tukey(),
        expected=line,
        sigma=np.full(2, np.inf),
        least_noise=1e-9 * start,
    )
    line = minimise(problem, line, RULES).state
    share = min(INDEPENDENT / len(rho), 1.0)
    error = float(np.sqrt(covariance_of(problem.linearise(line).H)[1, 1] / share))
    level = line[0] * float(np.median(rho))
    return float(-line[1]) if level > 0.0 and error < MOST_ERROR * level else None


def shifted_depth(
    z: Array,  # [H, W] of the network; NaN where unknown
    shift: float,
) -> Array:
    """[H, W] 1 / (1 / z + shift); NaN where that is no depth or too far away to be known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / z + shift
        inverse = np.where(inverse > 0.0, inverse, np.nan)
    if not np.isfinite(inverse).any():
        return inverse
    least = float(np.nanmedian(inverse)) / FARTHEST
    return np.asarray(np.where(inverse > least, 1.0 / inverse, np.nan))


def _slope_of_pairs(
    x: Array,  # [M]
    y: Array,  # [M]
) -> float | None:
    """Median slope (Theil and Sen) of pairs that differ; None where too few do."""
    run, rise = (
        np.concatenate([np.roll(values, len(values) // lag) - values for lag in LAGS])
        for values in (x, y)
    )
    differ = np.abs(run) > LEAST_SPREAD * x.std()
    if x.std() <= 1e-6 * np.abs(x).max() or differ.sum() < len(x) // 4:
        return None
    return float(np.median(rise[differ] / run[differ]))
