"""Attenuation that changes with range, from the illumination, as Sea-thru fits it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError

Array = npt.NDArray[np.float64]

BINS = 200
"""Ranges with as many pixels each, whose medians are fitted: on four dives as good as fitting the
pixels themselves, or up to 1.5 dB better."""
FEWEST = 20
"""Bins with light in every channel; four parameters are fitted to them."""
DARKEST_LIGHT = 1.0 / 255.0
"""Illumination below one step of 8 bits is noise."""
LARGEST_RATE = 20.0
"""Per median range; bounds what the exponentials add up to."""
STEEPEST = 20.0
"""Fall of the attenuation per median range."""


def two_exponentials(
    parameters: Array,  # [4] a, b, c, d
    z: Array,  # [M]
) -> Array:
    """[M] attenuation a exp(b z) + c exp(d z), b and d negative."""
    a, b, c, d = parameters
    return np.asarray(a * np.exp(b * z) + c * np.exp(d * z))


def fit_attenuation(
    light: Array,  # [M, 3] local illumination
    z: Array,  # [M] over the median range
) -> Array:
    """[3, 4] parameters for :func:`two_exponentials` of each channel.

    The range that the illumination implies, -log E / beta(z), is brought closest to ``z``.

    Raises:
        NotRestoredError: too little is lit.
    """
    by_range = np.array_split(np.argsort(z, kind="stable"), min(BINS, max(1, len(z))))
    medians = np.array([np.median(light[members], axis=0) for members in by_range if len(members)])
    ranges = np.array([np.median(z[members]) for members in by_range if len(members)])
    lit = (medians > DARKEST_LIGHT).all(axis=-1)
    if lit.sum() < FEWEST:
        raise NotRestoredError("too little light is left once the backscatter is taken off")
    depths = -np.log(np.minimum(medians[lit], 1.0))
    return np.stack([_fit(depth, ranges[lit]) for depth in depths.T])


def _fit(
    depth: Array,  # [M] optical depth of one channel
    z: Array,  # [M]
) -> Array:
    def residual(p: Array) -> Array:  # [4] a, b, c, d
        return np.asarray(depth / np.maximum(two_exponentials(p, z), 1e-6) - z)

    rate = float(np.clip(np.median(depth / z), 0.01, 0.45 * LARGEST_RATE))
    lower = np.array([0.0, -STEEPEST, 0.0, -STEEPEST])
    upper = np.array([LARGEST_RATE, 0.0, LARGEST_RATE, 0.0])
    fit = least_squares(residual, [rate, -0.1, rate, -2.0], bounds=(lower, upper))
    return np.asarray(fit.x)
