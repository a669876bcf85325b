"""Pairs of places and the points around them, and what each place makes of its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CENTRES_AT_ONCE = 4096
"""Balls in which neighbours are looked for at a time; some 100 MB with 500 points in each."""


def parts(count: int, size: int = CENTRES_AT_ONCE) -> Iterator[slice]:
    """Parts of ``count`` places."""
    for first in range(0, count, size):
        yield slice(first, min(count, first + size))


def pairs_within(
    tree: cKDTree,
    centres: Array,  # [N, 3] finite
    radius: float,
) -> tuple[Integers, Integers]:
    """Numbers of centres [K] and of the tree's points [K] within ``radius`` of them."""
    found = cKDTree(centres).sparse_distance_matrix(tree, radius, output_type="ndarray")
    return found["i"].astype(np.int64), found["j"].astype(np.int64)


def means_by(
    owner: Integers,  # [K]
    values: Array,  # [K, C]
    number: Integers,  # [n] of values of each owner
) -> Array:
    """[n, C] means of each owner's values; 0 of none."""
    sums = [np.bincount(owner, column, minlength=len(number)) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / np.maximum(number, 1)[:, None])
