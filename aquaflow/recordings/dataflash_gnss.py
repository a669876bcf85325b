"""Fixes and UTC of ArduPilot's dataflash logs: GPS records, and the accuracy from GPA.

A log that counts from 1970 has no leap seconds, GNSS time has: 18 since 2017-01-01 (IERS Bulletin
C), which is also what ArduPilot assumes.
"""

from __future__ import annotations

from typing import Any

from aquaflow.drivers.fixes import sigma_of
from aquaflow.types import Position, TelemetrySample, UtcTime

FIRST = 0
"""The receiver that is used."""
FIX_3D = 3
"""Status from which a fix places a vehicle."""
ACCURACY_LIFE_NS = 1_000_000_000
"""A GPA record follows its GPS record at once; receivers measure at 1 to 10 Hz."""
GPS_EPOCH_S = 315_964_800
"""1980-01-06, seconds since 1970."""
LEAP_S = 18
"""s that GNSS time is ahead of UTC since 2017."""
WEEK_NS = 604_800_000_000_000
"""A week of GNSS time."""


class GnssRecords:
    """The fixes of one log, in its order."""

    def __init__(self) -> None:
        self._accuracy: tuple[int, float] | None = None

    def accuracy(self, record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
        """GPA: HAcc, m, of the fixes that follow; 0 if the receiver states none."""
        if record.get("I", FIRST) == FIRST:
            self._accuracy = (t_ns, record["HAcc"])
        return []

    def fix(self, record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
        """GPS: where, and GNSS week with its milliseconds; week 0 while the time is unknown."""
        if record.get("I", FIRST) != FIRST or record["Status"] < FIX_3D:
            return []
        sigma_m = sigma_of(record["HDop"])
        if self._accuracy is not None and t_ns - self._accuracy[0] <= ACCURACY_LIFE_NS:
            sigma_m = self._accuracy[1] or sigma_m
        place = record["Lat"], record["Lng"]
        found: list[TelemetrySample] = [Position(t_ns, t_ns, source, *place, sigma_m)]
        if record["GWk"] > 0:
            since_ns = record["GWk"] * WEEK_NS + record["GMS"] * 1_000_000
            utc_ns = (GPS_EPOCH_S - LEAP_S) * 1_000_000_000 + since_ns
            found.append(UtcTime(t_ns, t_ns, source, utc_ns))
        return found
