"""Robust statistics of lengths in two dimensions, in sigmas of each component."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HUBER = 2.0
"""Sigmas where the loss turns linear: nine in ten normal errors are shorter."""
MEDIAN_SIGMAS = 1.1774
"""Median length of a normal error."""


def huber_weights(
    size: Array,  # [...] lengths over sigma
) -> Array:
    """[...] in (0, 1]."""
    return np.asarray(HUBER / np.maximum(size, HUBER))


def huber_cost(
    size: Array,  # [...] lengths over sigma
) -> Array:
    """[...] half the square, and its tangent from ``HUBER`` on."""
    near = np.minimum(size, HUBER)
    return np.asarray((size - 0.5 * near) * near)


def sigma_of(
    size: Array,  # [M] lengths
) -> float:
    """Standard deviation of each component, from the median; 0 for none."""
    return float(np.median(size)) / MEDIAN_SIGMAS if len(size) else 0.0
