"""Fixes and UTC of dataflash logs, written here as ArduPilot describes its records."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from pymavlink.DFReader import DFReaderClock

from aquaflow.recordings.dataflash import Dataflash
from aquaflow.types import Position, UtcTime

SIZES = {"Q": 8, "B": 1, "I": 4, "H": 2, "c": 2, "C": 2, "L": 4}
GPS = (1, b"GPS", b"QBBIHBcLL", b"TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng")
GPA = (2, b"GPA", b"QBC", b"TimeUS,I,HAcc")
WEEK, MS = 2446, 43_200_250
HERE = (-412_500_000, 1_748_000_000)


def described(kind: int, name: bytes, codes: bytes, labels: bytes) -> bytes:
    length = 3 + sum(SIZES[chr(code)] for code in codes)
    return b"\xa3\x95" + struct.pack("<BBB4s16s64s", 128, kind, length, name, codes, labels)


def gps(us: int, receiver: int = 0, status: int = 3, week: int = WEEK, hdop: int = 160) -> bytes:
    fields = (us, receiver, status, MS, week, 9, hdop, *HERE)
    return b"\xa3\x95\x01" + struct.pack("<QBBIHBhii", *fields)


def gpa(us: int, accuracy_cm: int, receiver: int = 0) -> bytes:
    return b"\xa3\x95\x02" + struct.pack("<QBH", us, receiver, accuracy_cm)


def log_of(path: Path, *records: bytes) -> Dataflash:
    path.write_bytes(described(*GPS) + described(*GPA) + b"".join(records))
    return Dataflash(path)


def test_a_fix_has_its_place_and_the_time_that_pymavlink_reads(tmp_path: Path) -> None:
    fix, utc = log_of(tmp_path / "a.bin", gps(5_000_000)).samples()

    assert isinstance(fix, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((-41.25, 174.8))
    assert fix.sigma_m == pytest.approx(1.6 * 5.1 / 2**0.5)
    assert isinstance(utc, UtcTime)
    assert (utc.t_ns, utc.source) == (0, "a/GPS")
    assert utc.utc_ns * 1e-9 == pytest.approx(DFReaderClock()._gpsTimeToTime(WEEK, MS), abs=1e-5)


def test_the_accuracy_that_the_receiver_states_is_used_while_it_is_new(tmp_path: Path) -> None:
    records = (
        *(gps(0), gpa(0, 70), gpa(0, 900, receiver=1), gps(200_000)),
        *(gps(2_000_000), gpa(2_000_000, 0), gps(2_200_000)),
    )
    found = log_of(tmp_path / "a.bin", *records).samples()

    by_hdop = 1.6 * 5.1 / 2**0.5
    sigmas_m = [sample.sigma_m for sample in found if isinstance(sample, Position)]
    assert sigmas_m == pytest.approx([by_hdop, 0.7, by_hdop, by_hdop])


def test_no_fix_and_the_second_receiver_give_nothing(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.bin", gps(0, status=1), gps(0, status=2), gps(0, receiver=1))

    assert list(log.samples()) == []
    assert log.notes == []


def test_a_fix_without_gnss_time_gives_no_utc(tmp_path: Path) -> None:
    (fix,) = log_of(tmp_path / "a.bin", gps(0, week=0)).samples()

    assert isinstance(fix, Position)


def test_damaged_descriptions_cost_their_records(tmp_path: Path) -> None:
    renamed = described(1, b"GPS", GPS[2], GPS[3].replace(b"Status", b"Statue"))
    path = tmp_path / "a.bin"
    path.write_bytes(renamed + gps(0))
    log = Dataflash(path)

    assert list(log.samples()) == []
    assert log.notes == ["1 records of a.bin hold no sane values"]
