"""ArduPilot's dataflash logs (.BIN): records that the log itself describes.

Every record starts with A3 95 and its type; records of type 128 (FMT) give length, name, format
and labels of the others (ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from aquaflow.drivers.samples import from_euler, plausible, sigma_of
from aquaflow.recordings.telemetry_log import TelemetryLog
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    UtcTime,
)

HEAD = b"\xa3\x95"
"""First bytes of a record; the third is its type."""
DESCRIPTION = 128
"""Type of the FMT records, which describe all others."""
FORMATS = {
    "b": "b", "B": "B", "M": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d",
    "q": "q", "Q": "Q", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I",
    "L": "i", "a": "64s", "g": "e",
}  # fmt: skip
"""Letters of FMT as struct's."""
SCALES = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
"""Value of one count of the scaled integers: hundredths, and 1e-7 degrees."""
FIRST = 0
"""The IMU and EKF core that are used; the others repeat them."""


@dataclass(frozen=True)
class _Layout:
    name: str
    fields: struct.Struct
    labels: tuple[str, ...]
    scales: tuple[float, ...]

    def read(self, data: bytes, at: int) -> dict[str, Any]:
        values = self.fields.unpack_from(data, at)
        scaled = (
            value if isinstance(value, bytes) or scale == 1.0 else value * scale
            for value, scale in zip(values, self.scales, strict=True)
        )
        return dict(zip(self.labels, scaled, strict=False))


class Dataflash(TelemetryLog):
    """ATT, IMU, CTUN, RFND and GPS as samples; times are the autopilot's TimeUS since the first."""

    suffixes = frozenset({".bin"})

    def records(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Name and fields of every record, text as bytes."""
        data = self.path.read_bytes()
        layouts: dict[int, _Layout] = {DESCRIPTION: _layout(b"FMT", b"BBnNZ", b"")}
        at = skipped = 0
        while at + 3 <= len(data):
            layout = layouts.get(data[at + 2]) if data.startswith(HEAD, at) else None
            if layout is None or at + 3 + layout.fields.size > len(data):
                following = data.find(HEAD, at + 1)
                following = len(data) if following < 0 else following
                skipped += following - at
                at = following
                continue
            if data[at + 2] == DESCRIPTION:
                kind, length, name, codes, labels = layout.fields.unpack_from(data, at + 3)
                described = _describe(name, codes, labels, length)
                if described is not None:
                    layouts[kind] = described
                yield "FMT", {"Type": kind, "Length": length, "Name": name}
            else:
                yield layout.name, layout.read(data, at + 3)
            at += 3 + layout.fields.size
        self.notes = [f"{skipped} bytes of {self.path.name} belong to no record"] if skipped else []

    def samples(self) -> Iterator[TelemetrySample]:
        first_us: int | None = None
        bad = 0
        gnss = GnssRecords()
        conversions = CONVERSIONS | {"GPS": gnss.fix, "GPA": gnss.accuracy}
        for name, record in self.records():
            if "TimeUS" not in record or name not in conversions:
                continue
            try:
                first_us = int(record["TimeUS"]) if first_us is None else first_us
                t_ns = round(self.starts_s * 1e9) + 1000 * (int(record["TimeUS"]) - first_us)
                found = conversions[name](record, t_ns, f"{self.path.stem}/{name}")
            except (KeyError, TypeError, ValueError, OverflowError):  # its description is damaged
                bad += 1
                continue
            sound = [sample for sample in found if plausible(sample)]
            bad += len(sound) < len(found)
            yield from sound
        if bad:
            self.notes.append(f"{bad} records of {self.path.name} hold no sane values")


def _describe(name: bytes, codes: bytes, labels: bytes, length: int) -> _Layout | None:
    """The layout that a FMT record gives; None if it contradicts itself."""
    try:
        layout = _layout(name, codes, labels)
    except (KeyError, UnicodeDecodeError):
        return None
    return layout if layout.fields.size + 3 == length else None


def _layout(name: bytes, codes: bytes, labels: bytes) -> _Layout:
    text = codes.rstrip(b"\0").decode("ascii")
    return _Layout(
        name.rstrip(b"\0").decode("ascii"),
        struct.Struct("<" + "".join(FORMATS[code] for code in text)),
        tuple(labels.rstrip(b"\0").decode("ascii").split(",")),
        tuple(SCALES.get(code, 1.0) for code in text),
    )


def _attitude(record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
    angles = [math.radians(record[label]) for label in ("Roll", "Pitch", "Yaw")]
    return [Attitude(t_ns, t_ns, source, from_euler(*angles))]


def _inertial(record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
    if record.get("I", FIRST) != FIRST:
        return []
    rate = (record["GyrX"], record["GyrY"], record["GyrZ"])
    force = (record["AccX"], record["AccY"], record["AccZ"])
    return [AngularRate(t_ns, t_ns, source, rate), Acceleration(t_ns, t_ns, source, force)]


def _height(record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
    """ArduSub's height above the surface, from its pressure sensor in the water."""
    return [Depth(t_ns, t_ns, source, -record["Alt"])]


def _range(record: dict[str, Any], t_ns: int, source: str) -> list[TelemetrySample]:
    good = record.get("Stat", 4) == 4 and record["Dist"] > 0.0
    return [Altitude(t_ns, t_ns, source, record["Dist"])] if good else []


CONVERSIONS = {"ATT": _attitude, "IMU": _inertial, "CTUN": _height, "RFND": _range}
"""The records that are read on their own, by name."""


# --------------------------------------------------------------------------------------------------
# Fixes and UTC of ArduPilot's dataflash logs: GPS records, and the accuracy from GPA.
#
# A log that counts from 1970 has no leap seconds, GNSS time has: 18 since 2017-01-01 (IERS Bulletin
# C), which is also what ArduPilot assumes.

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
