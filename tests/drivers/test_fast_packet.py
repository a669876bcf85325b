"""NMEA 2000 messages of several frames: put together, damaged, and what 129029 holds."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from aquaflow.config.instruments import Nmea2000Config
from aquaflow.drivers.protocol.nmea2000 import FastPackets, Nmea2000Decoder
from aquaflow.drivers.transport.can import EXTENDED, RECORD
from aquaflow.types import Position, TelemetrySample, UtcTime

NOW = 9_000_000_000
COUNT = 2000
LINK = {"kind": "can", "channel": "can0"}


def decoder() -> Nmea2000Decoder:
    return Nmea2000Decoder("bus", Nmea2000Config.model_validate({"link": LINK}))


def frames(message: bytes, number: int) -> Iterator[bytes]:
    """As a sender splits a message: 6 bytes, then 7 each, the last filled with 0xFF."""
    parts = [bytes([len(message)]) + message[:6]]
    parts += [message[at : at + 7] for at in range(6, len(message), 7)]
    for frame, part in enumerate(parts):
        yield bytes([number % 8 * 32 + frame]) + part.ljust(7, b"\xff")


def record(data: bytes, group: int = 129029, sender: int = 35) -> bytes:
    return RECORD.pack(EXTENDED | 3 << 26 | group << 8 | sender, len(data), data)


def fix(days: int, clock: int, place: tuple[int, int], method: int, hdop: int) -> bytes:
    """129029 field by field, least significant byte first."""
    fields = [(7, 1), (days, 2), (clock, 4), (place[0], 8), (place[1], 8), (0, 8)]
    fields += [(method << 4, 1), (0xFC, 1), (12, 1), (hdop, 2), (0x7FFF, 2), (0, 4), (0, 1)]
    return b"".join(value.to_bytes(size, "little", signed=value < 0) for value, size in fields)


def heard(receiver: Nmea2000Decoder, message: bytes, number: int) -> list[TelemetrySample]:
    return [
        sample for data in frames(message, number) for sample in receiver.feed(record(data), NOW)
    ]


def test_every_129029_means_what_was_encoded() -> None:
    draw, receiver, mismatches = random.Random(129029), decoder(), 0
    for number in range(COUNT):
        days, clock = draw.randint(11_000, 40_000), draw.randint(0, 863_999_999)
        place = (draw.randint(-89 * 10**16, 89 * 10**16), draw.randint(-179 * 10**16, 179 * 10**16))
        method, hdop = draw.randint(0, 8), draw.choice([0x7FFF, draw.randint(50, 900)])
        found = heard(receiver, fix(days, clock, place, method, hdop), number)
        sigma_m = (2.0 if hdop == 0x7FFF else hdop / 100.0) * 5.1 / 2.0**0.5
        if not 1 <= method <= 5:
            mismatches += found != []
            continue
        utc, position = found
        assert isinstance(utc, UtcTime)
        assert isinstance(position, Position)
        mismatches += utc.utc_ns != days * 86_400 * 10**9 + clock * 10**5
        values = (position.latitude_deg, position.longitude_deg, position.sigma_m)
        mismatches += values != pytest.approx(
            (place[0] / 1e16, place[1] / 1e16, sigma_m), rel=1e-12
        )
    assert mismatches == 0
    assert receiver.counters.invalid_values == 0


def test_the_position_of_129025_goes_before_that_of_129029() -> None:
    receiver = decoder()
    place = (600_000_000).to_bytes(4, "little") + (100_000_000).to_bytes(4, "little")
    [first] = receiver.feed(record(place, 129025), NOW)
    assert isinstance(first, Position)
    message = fix(20_000, 0, (60 * 10**16, 10 * 10**16), 1, 100)
    assert [type(sample) for sample in heard(receiver, message, 0)] == [UtcTime]


def test_senders_whose_frames_alternate_do_not_disturb_each_other() -> None:
    packets, first, second = FastPackets(), bytes(range(43)), bytes(range(100, 143))
    found = []
    for one, other in zip(frames(first, 1), frames(second, 1), strict=True):
        found += [packets.add(1, one), packets.add(2, other)]
    assert [each for each in found if each is not None] == [first, second]


@pytest.mark.parametrize("lost", range(6))
def test_a_lost_frame_costs_its_message_alone(lost: int) -> None:
    receiver = decoder()
    message = fix(20_000, 0, (60 * 10**16, 10 * 10**16), 1, 100)
    kept = [data for at, data in enumerate(frames(message, 0)) if at != lost]
    assert [sample for data in kept for sample in receiver.feed(record(data), NOW)] == []
    assert receiver.counters.invalid_values > 0
    assert len(heard(receiver, message, 1)) == 2


@pytest.mark.parametrize("length", [0, 224])
def test_an_impossible_length_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match="length"):
        FastPackets().add(1, bytes([0, length]) + b"\0" * 6)
