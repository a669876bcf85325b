"""What telemetry measured, looked up at the moments of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.telemetry.telemetry import Series

LONGEST_GAP_S = 2.0
"""Two samples further apart are not connected: the slowest altimeters send one a second."""


@dataclass(frozen=True)
class Interpolation:
    """One quantity over time; between two samples it is linear."""

    t_s: npt.NDArray[np.float64]
    """[N] s of the dive's clock, strictly increasing."""
    values: npt.NDArray[np.float64]
    """[N] finite, in the unit of the quantity."""

    @staticmethod
    def of(sources: Sequence[Series]) -> Interpolation:
        """The first value of the source with most samples; of equals, the first. Others would only
        make it jump."""
        if not sources:
            return Interpolation(np.zeros(0), np.zeros(0))
        chosen = max(sources, key=len)
        values = chosen.values[:, 0]
        finite = np.isfinite(values)
        return Interpolation(chosen.t_s[finite], values[finite])

    def at(self, t_ns: int) -> float | None:
        """The value at a moment; None before the first sample, after the last, and in gaps."""
        t_s = t_ns * 1e-9
        after = int(np.searchsorted(self.t_s, t_s))
        if after == len(self.t_s):
            return None
        if self.t_s[after] == t_s:
            return float(self.values[after])
        if after == 0 or self.t_s[after] - self.t_s[after - 1] > LONGEST_GAP_S:
            return None
        nearest = slice(after - 1, after + 1)
        return float(np.interp(t_s, self.t_s[nearest], self.values[nearest]))


def columns_at(
    t_s: npt.NDArray[np.float64],  # [M] s
    known_s: npt.NDArray[np.float64],  # [N] s, increasing
    values: npt.NDArray[np.float64],  # [N, C]
) -> npt.NDArray[np.float64]:
    """[M, C] each column between its neighbours in time; the ends hold beyond them."""
    return np.stack([np.interp(t_s, known_s, column) for column in values.T], axis=1)
