"""Trajectories of different sources, associated by time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.dive.tum import Trajectory, read_tum

__all__ = ["ASSOCIATION_TOLERANCE_S", "Trajectory", "associate", "read_tum"]

ASSOCIATION_TOLERANCE_S = 0.01
"""Two poses are of the same moment if their times differ by less: one centimetre at 1 m/s."""


def associate(
    first_s: npt.NDArray[np.float64],  # [N] s, increasing
    second_s: npt.NDArray[np.float64],  # [M] s, increasing
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices [K] into both lists of the times that are each other's nearest, within tolerance."""
    if len(first_s) == 0 or len(second_s) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    to_second = _nearest(first_s, second_s)
    to_first = _nearest(second_s, first_s)
    first = np.arange(len(first_s))
    mutual = to_first[to_second] == first
    close = np.abs(second_s[to_second] - first_s) <= tolerance_s
    kept = np.flatnonzero(mutual & close)
    return kept, to_second[kept]


def _nearest(
    of: npt.NDArray[np.float64],  # [N] s
    among: npt.NDArray[np.float64],  # [M] s, increasing
) -> npt.NDArray[np.intp]:
    """Indices [N] into ``among`` [M] of the times nearest to ``of`` [N], the earlier on a tie."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(among) - 1)
    return np.where(of - among[before] <= among[after] - of, before, after)
