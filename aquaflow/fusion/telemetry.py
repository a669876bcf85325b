"""All telemetry of a dive, by kind and source, as arrays in the order of measurement."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.messages import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Series:
    """What one source measured."""

    source: str
    t_s: Array
    """[N] s of the dive's clock, strictly increasing."""
    values: Array
    """[N, K] in the units of the message."""

    def __len__(self) -> int:
        return len(self.t_s)

    def between(self, first_s: float, last_s: float) -> Series:
        """The samples of that time."""
        chosen = (self.t_s >= first_s) & (self.t_s <= last_s)
        return Series(self.source, self.t_s[chosen], self.values[chosen])

    def thinned(self, most: int) -> Series:
        """At most so many samples, evenly chosen."""
        step = max(1, -(-len(self) // most))
        return Series(self.source, self.t_s[::step], self.values[::step])


class Telemetry:
    """Grows with every sample; about 40 bytes for each."""

    def __init__(self) -> None:
        self._columns: dict[tuple[type, str], array[float]] = {}
        self._width: dict[tuple[type, str], int] = {}
        self._series: dict[tuple[type, str], Series] = {}
        self.utc: list[UtcTime] = []
        """Not among the arrays: nanoseconds since 1970 need all 64 bits."""

    def add(self, sample: TelemetrySample) -> None:
        """Keep a sample."""
        if isinstance(sample, UtcTime):
            self.utc.append(sample)
            return
        key = (type(sample), sample.source)
        row = (sample.t_ns * 1e-9, *_values(sample))
        self._width[key] = len(row)
        self._columns.setdefault(key, array("d")).extend(row)
        self._series.pop(key, None)

    def __bool__(self) -> bool:
        return bool(self._columns) or bool(self.utc)

    def copy(self) -> Telemetry:
        """What is there now, to be read by another thread."""
        other = Telemetry()
        other._columns = {key: column[:] for key, column in self._columns.items()}
        other._width, other.utc = dict(self._width), list(self.utc)
        return other

    def of(self, kind: type) -> list[Series]:
        """The series of all sources of one kind of message, by name."""
        keys = sorted((key for key in self._columns if key[0] is kind), key=lambda key: key[1])
        return [self._of(key) for key in keys]

    def _of(self, key: tuple[type, str]) -> Series:
        if key not in self._series:
            rows = np.array(self._columns[key]).reshape(-1, self._width[key])
            _, first = np.unique(rows[:, 0], return_index=True)
            self._series[key] = Series(key[1], rows[first, 0], rows[first, 1:])
        return self._series[key]


FIELDS: dict[type, tuple[str, ...]] = {
    Depth: ("depth_m",),
    Attitude: ("wxyz",),
    AngularRate: ("rate_rad_s",),
    Acceleration: ("acceleration_m_s2",),
    Velocity: ("velocity_m_s", "figure_of_merit_m_s"),
    Altitude: ("altitude_m",),
    Lights: ("level",),
    Position: ("latitude_deg", "longitude_deg", "sigma_m"),
}
"""What is kept of each kind of message, in the order of the columns."""


def _values(sample: TelemetrySample) -> list[float]:
    values: list[float] = []
    for name in FIELDS[type(sample)]:
        value = getattr(sample, name)
        values += value if isinstance(value, tuple) else (value,)
    return values
