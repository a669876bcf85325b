"""Thousands of NMEA 2000 positions and times, encoded field by field, least significant byte first.

An encoder of the same text was read alike by the library nmea2000 (Apache-2.0, not installed here).
"""

from __future__ import annotations

import math
import random

import pytest

from aquaflow.config.instruments import Nmea2000Config
from aquaflow.drivers.protocol.nmea2000 import Nmea2000Decoder
from aquaflow.drivers.transport.can import EXTENDED, RECORD
from aquaflow.types import Position, UtcTime

COUNT = 3000
NOW = 9_000_000_000
LINK = {"kind": "can", "channel": "can0"}
DAY_S = 86_400


def decoder() -> Nmea2000Decoder:
    return Nmea2000Decoder("bus", Nmea2000Config.model_validate({"link": LINK}))


def frame(group: int, *fields: tuple[int, int]) -> bytes:
    """A frame of (value, bytes) pairs; a negative value as two's complement."""
    data = b"".join((value % (1 << 8 * size)).to_bytes(size, "little") for value, size in fields)
    return RECORD.pack(EXTENDED | 3 << 26 | group << 8 | 17, len(data), data.ljust(8, b"\xff"))


def test_every_129025_means_what_was_encoded_as_its_129539_says() -> None:
    draw, receiver, mismatches = random.Random(129025), decoder(), 0
    for number in range(COUNT):
        lat, lon = (
            draw.randrange(-89 * 10**7, 89 * 10**7),
            draw.randrange(-179 * 10**7, 179 * 10**7),
        )
        mode, hdop = draw.choice([0, 1, 2, 2, 3]), draw.choice([0x7FFF, draw.randint(50, 900)])
        receiver.feed(frame(129539, (number % 253, 1), (2 | mode << 3 | 0xC0, 1), (hdop, 2),
                            (100, 2), (0x7FFF, 2)), NOW)  # fmt: skip
        found = receiver.feed(frame(129025, (lat, 4), (lon, 4)), NOW)
        sigma_m = (2.0 if hdop == 0x7FFF else hdop / 100.0) * 5.1 / math.sqrt(2.0)
        place = pytest.approx((lat / 1e7, lon / 1e7, sigma_m), rel=1e-12)
        expected = [place] if mode in (1, 2) else []
        mismatches += [
            (s.latitude_deg, s.longitude_deg, s.sigma_m) for s in found if isinstance(s, Position)
        ] != expected
    assert mismatches == 0
    assert receiver.counters.messages == 2 * COUNT
    assert receiver.counters.invalid_values == 0


def test_every_126992_means_what_was_encoded() -> None:
    draw, receiver, mismatches = random.Random(126992), decoder(), 0
    for number in range(COUNT):
        days, clock = draw.randint(12_000, 40_000), draw.randrange(DAY_S * 10_000)
        source = draw.randint(0, 5)
        data = frame(126992, (number % 253, 1), (0xF0 | source, 1), (days, 2), (clock, 4))
        utc_ns = days * DAY_S * 10**9 + clock * 100_000
        expected = [] if source == 5 else [UtcTime(NOW, NOW, "bus/126992", utc_ns)]
        mismatches += receiver.feed(data, NOW) != expected
    assert mismatches == 0
    assert receiver.counters.messages == COUNT
    assert receiver.counters.invalid_values == 0
