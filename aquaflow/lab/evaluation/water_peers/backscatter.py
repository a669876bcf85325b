"""Backscatter over range from the darkest pixels, as Sea-thru finds it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError

Array = npt.NDArray[np.float64]

BINS = 10
"""Evenly spaced ranges whose darkest pixels are taken."""
DARKEST_PERCENT = 1.0
"""Of the pixels of a bin, by the sum of their channels."""
FEWEST = 12
"""Dark pixels; four parameters for each channel are fitted to them."""
LARGEST_RATE = 5.0
"""Of backscatter and of the remaining attenuation, per median range."""
STARTS = (0.5, 2.0)
"""Rates per median range that the fit starts from; the better end counts."""


def backscatter(
    veil: Array,  # [3, 4] per channel: B_inf, rate, J', rate of J'
    z: Array,  # [M]
) -> Array:
    """[M, 3] light that the water adds over the range ``z``."""
    return np.asarray(veil[:, 0] * -np.expm1(-veil[:, 1] * z[:, None]))


def fit_backscatter(
    colours: Array,  # [M, 3] in [0, 1]
    z: Array,  # [M] over the median range
) -> Array:
    """[3, 4] parameters for :func:`backscatter`: what dark pixels show is nearly all backscatter.

    Raises:
        NotRestoredError: there are too few dark pixels.
    """
    chosen = _darkest(colours, z)
    if len(chosen) < FEWEST:
        raise NotRestoredError("too few dark pixels show the backscatter")
    return np.stack([_fit_backscatter(channel, z[chosen]) for channel in colours[chosen].T])


def _darkest(
    colours: Array,  # [M, 3]
    z: Array,  # [M]
) -> npt.NDArray[np.intp]:
    edges = np.linspace(z.min(), z.max(), BINS + 1)
    bin_of = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, BINS - 1)
    brightness = colours.sum(axis=1)
    chosen = []
    for each in range(BINS):
        members = np.flatnonzero(bin_of == each)
        count = int(len(members) * DARKEST_PERCENT / 100.0)
        chosen.append(members[np.argsort(brightness[members], kind="stable")[:count]])
    return np.concatenate(chosen)


def _fit_backscatter(
    values: Array,  # [M] one channel of dark pixels
    z: Array,  # [M]
) -> Array:
    def residual(p: Array) -> Array:  # [4] B_inf, rate, J', rate of J'
        return np.asarray(-p[0] * np.expm1(-p[1] * z) + p[2] * np.exp(-p[3] * z) - values)

    upper = np.array([1.0, LARGEST_RATE, 1.0, LARGEST_RATE])
    brightest = float(np.clip(values.max(), 0.01, 0.99))
    fits = [
        least_squares(residual, [brightest, rate, 0.01, rate], bounds=(np.zeros(4), upper))
        for rate in STARTS
    ]
    return np.asarray(min(fits, key=lambda fit: float(fit.cost)).x)
