"""The simulated instruments of a synthetic dive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aquaflow.recordings.sample_table import read_telemetry
from aquaflow.recordings.synthetic import SyntheticDive
from aquaflow.types import TelemetrySample

TELEMETRY = "telemetry.csv"
"""File of a synthetic dive."""


class SyntheticTelemetry:
    """Samples in the order of arrival, on the clock of the dive's pictures."""

    specificity = 2

    def __init__(self, folder: Path, starts_s: float = 0.0) -> None:
        """``starts_s`` is the time of the first picture on the caller's clock."""
        self.folder = folder
        self.notes: list[str] = []
        self._shift_ns = round(starts_s * 1e9)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return SyntheticDive.recognises(path) and (path / TELEMETRY).is_file()

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> SyntheticTelemetry:
        return cls(path, starts_s)

    def samples(self) -> Iterator[TelemetrySample]:
        """Raises InputError where the file is damaged."""
        for sample in read_telemetry(self.folder / TELEMETRY):
            t_ns, arrival_ns = sample.t_ns + self._shift_ns, sample.arrival_ns + self._shift_ns
            yield replace(sample, t_ns=t_ns, arrival_ns=arrival_ns)

    def close(self) -> None:
        """Nothing stays open between passes."""
