"""Means of values that belong together: a point's observations, a region's points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


def mean_by(
    group: Index,  # [M] number of each value's group
    values: Array,  # [M, K]
) -> Array:
    """[G, K] mean over each group; 0 for one without values."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=-1)
