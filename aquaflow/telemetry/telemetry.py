"""All telemetry of a dive, by kind and source, as arrays in the order of measurement."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.types import TelemetrySample, UtcTime, values_of

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

    def thin(self, most: int) -> Series:
        """The series with at most so many samples, evenly chosen."""
        step = max(1, -(-len(self) // most))
        return Series(self.source, self.t_s[::step], self.values[::step])


def device_of(source: str) -> str:
    """Name of the device that a source belongs to; its sources have one clock."""
    return source.split("/", 1)[0]


CHUNK = 1024
"""Rows of a source that copies share once they are complete: after two hours with an IMU at 200 Hz
a whole copy takes 50 ms, which tracking would wait for."""


class _Table:
    """Rows of one source and kind: complete chunks, which never change, and the newest rows."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._chunks: list[Array] = []
        self._newest = array("d")

    def add(self, row: Sequence[float]) -> None:
        self._newest.extend(row)
        if len(self._newest) == CHUNK * self._width:
            self._chunks.append(self._rows_of_newest())
            self._newest = array("d")

    def copy(self) -> _Table:
        other = _Table(self._width)
        other._chunks, other._newest = self._chunks[:], self._newest[:]
        return other

    def rows(self) -> Array:
        """[N, K]"""
        return np.concatenate([*self._chunks, self._rows_of_newest()])

    def _rows_of_newest(self) -> Array:
        return np.array(self._newest).reshape(-1, self._width)


class Telemetry:
    """Grows with every sample; about 40 bytes for each."""

    def __init__(self) -> None:
        self._tables: dict[tuple[type, str], _Table] = {}
        self._series: dict[tuple[type, str], Series] = {}
        self.utc: list[UtcTime] = []
        """Not among the arrays: nanoseconds since 1970 need all 64 bits."""

    def add(self, sample: TelemetrySample) -> None:
        """Keep a sample.

        Raises:
            ArithmeticError: a value of it is not finite; one such would spoil every estimate.
        """
        if isinstance(sample, UtcTime):
            self.utc.append(sample)
            return
        key = (type(sample), sample.source)
        row = (sample.t_ns * 1e-9, *values_of(sample))
        if not all(map(math.isfinite, row)):
            raise ArithmeticError(f"a sample of '{sample.source}' is not finite")
        if key not in self._tables:
            self._tables[key] = _Table(len(row))
        self._tables[key].add(row)
        self._series.pop(key, None)

    def __bool__(self) -> bool:
        return bool(self._tables) or bool(self.utc)

    def copy(self) -> Telemetry:
        """What is there now, to be read by another thread; its cost hardly grows with the dive."""
        other = Telemetry()
        other._tables = {key: table.copy() for key, table in self._tables.items()}
        other.utc = list(self.utc)
        return other

    def retime(self, change: Callable[[Series], Series]) -> Telemetry:
        """The same with every series as ``change`` gives it."""
        other = self.copy()
        other._series = {key: change(self._of(key)) for key in self._tables}
        return other

    def of(self, kind: type) -> list[Series]:
        """The series of all sources of one kind of message, by name."""
        keys = sorted((key for key in self._tables if key[0] is kind), key=lambda key: key[1])
        return [self._of(key) for key in keys]

    def _of(self, key: tuple[type, str]) -> Series:
        if key not in self._series:
            rows = self._tables[key].rows()
            _, first = np.unique(rows[:, 0], return_index=True)
            self._series[key] = Series(key[1], rows[first, 0], rows[first, 1:])
        return self._series[key]
