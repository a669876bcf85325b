"""The length of the camera's way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.robust import sigma_of
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity
from aquaflow.survey.measure.scale import Scale

Array = npt.NDArray[np.float64]

THIRD_DIFFERENCES = 20.0
"""Variance of a third difference over that of one place: 1 + 9 + 9 + 1."""
LEAST_POSES = 5
"""For two third differences."""


def way(
    places: Array,  # [N, 3] camera centres in order of time
    scale: Scale,
) -> Quantity | None:
    """The way through all places; None where there are fewer than two.

    Jitter of the poses lengthens it. Third differences of the places, in which a steady motion
    cancels, bound the jitter; what the vehicle's own unrest adds to them is taken for jitter, too,
    so that the interval reaches down farther than it has to and the value is left as measured.
    """
    if len(places) < 2:
        return None
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    value = float(lengths.sum())
    longer = 0.0
    if len(places) >= LEAST_POSES:
        third = np.diff(places, 3, axis=0)
        jitter = sigma_of(third) / np.sqrt(THIRD_DIFFERENCES)
        # Three directions, and both ends of each step: E |d + n|^2 = |d|^2 + 6 sigma^2.
        shorter = np.sqrt(np.maximum(lengths**2 - 6.0 * jitter**2, 0.0))
        longer = float((lengths - shorter).sum())
    half = NORMAL_95 * scale.sigma * value
    low = max(0.0, value - float(np.hypot(half, longer)))
    sigma = (half + value - low) / (2.0 * NORMAL_95)
    return Quantity(value, sigma, low, value + half, scale.unit)
