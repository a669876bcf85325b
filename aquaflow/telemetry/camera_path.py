"""The camera's path in one sub-map at any moment, and what telemetry measured then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from aquaflow.telemetry.telemetry import Series

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LONGEST_GAP_S = 1.5
"""Between two poses, across which the path is interpolated; a survey camera takes one picture a
second, and an ROV changes its speed within a few seconds."""


SAME_S = 1e-6
"""A moment so near to a pose is the pose's; sums of seconds round by less."""


@dataclass(frozen=True)
class CameraPath:
    """Camera poses of one sub-map in its own world m, map units."""

    t_s: Array
    """[N] s, strictly increasing."""
    R_mc: Array
    """[N, 3, 3] camera to map."""
    p_m: Array
    """[N, 3] camera centre."""

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def middle_s(self) -> float:
        """s, between the first pose and the last."""
        return float(0.5 * (self.t_s[0] + self.t_s[-1]))

    def covers(
        self,
        t_s: Array,  # [M] s
    ) -> Mask:
        """[M] moments at which the path is known: those of poses, and those in short gaps."""
        if len(self) < 2:
            return np.zeros(len(t_s), dtype=bool)
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self) - 1)
        short = (self.t_s[after] - self.t_s[after - 1]) <= LONGEST_GAP_S
        apart = np.minimum(np.abs(self.t_s[after] - t_s), np.abs(self.t_s[after - 1] - t_s))
        inside = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1])
        return np.asarray((short & inside) | (apart <= SAME_S))

    def at(
        self,
        t_s: Array,  # [M] s, covered
    ) -> tuple[Array, Array]:
        """Rotations [M, 3, 3], at constant rates between poses, and camera centres [M, 3], on cubic
        curves: chords of a loop in 4 s with 10 poses a second would make it 0.2 % smaller."""
        t_s = np.clip(t_s, self.t_s[0], self.t_s[-1])
        rotations = Slerp(self.t_s, Rotation.from_matrix(self.R_mc))(t_s).as_matrix()
        centres = CubicHermiteSpline(self.t_s, self.p_m, self._slope)(t_s)
        return np.asarray(rotations), np.asarray(centres)

    def velocity(
        self,
        t_s: Array,  # [M] s, covered
    ) -> Array:
        """[M, 3] map units/s."""
        return columns_at(t_s, self.t_s, self._slope)

    @property
    def _slope(self) -> Array:
        """[N, 3] map units/s at the poses."""
        order: Literal[1, 2] = 2 if len(self) > 2 else 1
        return np.asarray(np.gradient(self.p_m, self.t_s, axis=0, edge_order=order))


# --------------------------------------------------------------------------------------------------
# What telemetry measured, looked up at the moments of frames.

LONGEST_INTERPOLATED_S = 2.0
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
        if after == 0 or self.t_s[after] - self.t_s[after - 1] > LONGEST_INTERPOLATED_S:
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
