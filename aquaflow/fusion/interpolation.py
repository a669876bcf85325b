"""A measured quantity over time, looked up at the moments of frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

LONGEST_GAP_NS = 2_000_000_000
"""Two samples further apart, ns, are not connected: the slowest altimeters send one a second."""


@dataclass(frozen=True)
class Series:
    """Samples in the order of their times; between two of them the value is linear."""

    t_ns: npt.NDArray[np.int64]
    """[N] strictly increasing, on the clock of the frames."""
    values: npt.NDArray[np.float64]
    """[N] in the unit of the quantity."""

    @staticmethod
    def of(samples: Iterable[tuple[int, float]]) -> Series:
        """From pairs of t_ns and value in any order; of several at one moment the last counts, and
        values that are not finite are left out."""
        by_time = {t_ns: value for t_ns, value in samples if np.isfinite(value)}
        times = sorted(by_time)
        return Series(np.array(times, np.int64), np.array([by_time[t] for t in times], np.float64))

    def at(self, t_ns: int) -> float | None:
        """The value at ``t_ns``; None before the first sample, after the last, and in gaps."""
        after = int(np.searchsorted(self.t_ns, t_ns))
        if after == len(self.t_ns):
            return None
        if self.t_ns[after] == t_ns:
            return float(self.values[after])
        if after == 0:
            return None
        gap_ns = int(self.t_ns[after] - self.t_ns[after - 1])
        if gap_ns > LONGEST_GAP_NS:
            return None
        share = (t_ns - int(self.t_ns[after - 1])) / gap_ns
        before, then = self.values[after - 1], self.values[after]
        return float(before + share * (then - before))
