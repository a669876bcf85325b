"""How something turned, interval by interval: of a camera by its poses, of a vehicle by its
instruments.

A turn is the rotation over one interval of time, as a vector about its own axes; divided by the
length of the interval it is the mean rate. Poses give nothing but such means, so rates are
integrated over the same intervals before the two are compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from aquaflow.telemetry.telemetry import Series
from aquaflow.types import AngularRate, Attitude, TelemetrySample, values_of

Array = npt.NDArray[np.float64]

LONGEST_INTERVAL_S = 1.5
"""Over a longer one an ROV may turn to and fro: pictures at 1 per second still count, a loss of
tracking or of the link does not."""
FEW_RATES_HZ = 5.0
"""A gyro that is logged more slowly misses the sway of a small ROV (2 s and longer) between two of
its samples; attitudes miss nothing."""
NO_SERIES = Series("", np.empty(0), np.empty((0, 4)))


@dataclass(frozen=True)
class Turns:
    """Rotations over intervals of time, in order; gaps between intervals are allowed."""

    start_s: Array
    """[K]"""
    end_s: Array
    """[K]"""
    angle_rad: Array
    """[K, 3] rotation vector over the interval, in the axes of what turns."""

    @staticmethod
    def of_orientations(
        t_s: Array,  # [N]
        R_wb: Array,  # [N, 3, 3] of what turns to a frame at rest
    ) -> Turns:
        """Turns between orientations; times that do not rise, and long intervals, are left out."""
        relative = np.swapaxes(R_wb[:-1], 1, 2) @ R_wb[1:]
        angle = Rotation.from_matrix(relative).as_rotvec() if len(relative) else np.empty((0, 3))
        return Turns(t_s[:-1], t_s[1:], angle)._usable()

    @staticmethod
    def of_rates(
        t_s: Array,  # [M]
        rate_rad_s: Array,  # [M, 3]
    ) -> Turns:
        """Turns between samples of a gyro, by the trapezoidal rule."""
        angle = np.diff(t_s)[:, None] * 0.5 * (rate_rad_s[:-1] + rate_rad_s[1:])
        return Turns(t_s[:-1], t_s[1:], angle)._usable()

    @staticmethod
    def join(parts: Sequence[Turns]) -> Turns:
        """The turns of several sub-maps, of which none overlaps another, as one."""
        parts = sorted((part for part in parts if len(part.start_s)), key=lambda p: p.start_s[0])
        if not parts:
            return Turns(np.empty(0), np.empty(0), np.empty((0, 3)))
        return Turns(
            np.concatenate([part.start_s for part in parts]),
            np.concatenate([part.end_s for part in parts]),
            np.concatenate([part.angle_rad for part in parts]),
        )

    def _usable(self) -> Turns:
        length = self.end_s - self.start_s
        finite = np.isfinite(self.angle_rad).all(axis=1) & np.isfinite(length)
        keep = finite & (length > 0.0) & (length <= LONGEST_INTERVAL_S)
        return Turns(self.start_s[keep], self.end_s[keep], self.angle_rad[keep])

    @property
    def covered_s(self) -> float:
        """Sum of the intervals."""
        return float((self.end_s - self.start_s).sum())

    def within(
        self,
        start_s: Array,  # [N]
        end_s: Array,  # [N]
    ) -> tuple[Array, Array]:
        """Angle [N, 3] turned over other intervals, and the share [N] of each that is covered."""
        edges = np.column_stack([self.start_s, self.end_s]).ravel()
        rises = np.zeros((len(edges), 4))
        rises[1::2, :3] = self.angle_rad
        rises[1::2, 3] = self.end_s - self.start_s
        total = np.cumsum(rises, axis=0)
        found = np.column_stack(
            [
                np.interp(end_s, edges, column) - np.interp(start_s, edges, column)
                for column in total.T
            ]
        )
        return found[:, :3], found[:, 3] / (end_s - start_s)


def smoothing(
    turns: Turns,
    at_s: Array,  # [G]
    sigma_s: float,
) -> tuple[csr_array, Array]:
    """Operator [G, K] from angles to rates smoothed by a Gaussian, and its coverage [G], 0 to 1."""
    reach_s = 3.0 * sigma_s
    middle = 0.5 * (turns.start_s + turns.end_s)
    first = np.searchsorted(middle, at_s - reach_s)
    count = np.searchsorted(middle, at_s + reach_s) - first
    row = np.repeat(np.arange(len(at_s)), count)
    column = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + first[row]
    weight = np.exp(-0.5 * ((middle[column] - at_s[row]) / sigma_s) ** 2)
    length = (turns.end_s - turns.start_s)[column]
    total = np.bincount(row, weight * length, len(at_s))
    operator = csr_array((weight / total[row], (row, column)), (len(at_s), len(middle)))
    return operator, total / (np.sqrt(2.0 * np.pi) * sigma_s)


def turns_of_telemetry(samples: Iterable[TelemetrySample]) -> tuple[str, Turns] | None:
    """The best source of rotations among ``samples``, with its name; None where there is none."""
    rates: dict[str, list[AngularRate]] = {}
    attitudes: dict[str, list[Attitude]] = {}
    for sample in samples:
        if isinstance(sample, AngularRate):
            rates.setdefault(sample.source, []).append(sample)
        elif isinstance(sample, Attitude):
            attitudes.setdefault(sample.source, []).append(sample)
    return best_turns(
        [_in_order(source, found) for source, found in rates.items()],
        [_in_order(source, found) for source, found in attitudes.items()],
    )


def best_turns(rates: Sequence[Series], attitudes: Sequence[Series]) -> tuple[str, Turns] | None:
    """The best source of rotations, with its name; None where there is none.

    A gyro counts before attitudes, unless it was logged more slowly than they were, or too slowly
    to be integrated; of equals, the source with more samples.
    """
    gyro = max(rates, key=len, default=NO_SERIES)
    ahrs = max(attitudes, key=len, default=NO_SERIES)
    if len(gyro) >= len(ahrs) or _frequency_hz(gyro) >= FEW_RATES_HZ:
        return (gyro.source, Turns.of_rates(gyro.t_s, gyro.values)) if len(gyro) >= 2 else None
    R_nb = Rotation.from_quat(np.roll(ahrs.values, -1, axis=1)).as_matrix()
    return ahrs.source, Turns.of_orientations(ahrs.t_s, R_nb)


def _frequency_hz(series: Series) -> float:
    if len(series) < 2:
        return 0.0
    return float(1.0 / max(np.median(np.diff(series.t_s)), 1e-9))


def _in_order(source: str, samples: Sequence[AngularRate | Attitude]) -> Series:
    """The samples by time."""
    times = np.array([sample.t_ns for sample in samples]) * 1e-9
    order = np.argsort(times, kind="stable")
    values = np.asarray([values_of(sample) for sample in samples], dtype=float)
    return Series(source, times[order], values[order])
