"""A Teledyne DVL that sends PD0 ensembles in ship coordinates."""

from __future__ import annotations

import struct
from datetime import datetime, timedelta, timezone

from aquaflow.messages import Altitude, TelemetrySample, Velocity
from aquaflow.sim_drivers.devices.device import OneWayDevice

SHIP_COORDINATES = 2 << 3
"""Byte 25 of the fixed leader: bits 3 and 4 are 2 for ship axes."""
FIXED_BYTES, VARIABLE_BYTES, BOTTOM_BYTES = 58, 77, 81
"""Lengths of the fixed leader, the variable leader and the bottom track, as far as they are
read."""
EPOCH = datetime(2026, 1, 1, tzinfo=timezone.utc)
"""Where the real time clock stood when the device was switched on."""


class Pd0Dvl(OneWayDevice[bytes]):
    """Velocity of the bottom past the instrument, with the last altitude in all four beams."""

    def __init__(self) -> None:
        self._altitude_m = 0.0
        self._ensemble = 0

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        match sample:
            case Altitude():
                self._altitude_m = sample.altitude_m
            case Velocity():
                self._ensemble += 1
                return [ensemble(self._fixed(), self._variable(measured_ns), self._bottom(sample))]
        return []

    def _fixed(self) -> bytes:
        leader = bytearray(FIXED_BYTES)
        leader[25] = SHIP_COORDINATES
        return bytes(leader)

    def _variable(self, measured_ns: int) -> bytes:
        clock = EPOCH + timedelta(microseconds=measured_ns // 1000)
        leader = bytearray(VARIABLE_BYTES)
        struct.pack_into(
            "<HH7B", leader, 0, 0x0080, self._ensemble % 65536, clock.year - 2000, clock.month,
            clock.day, clock.hour, clock.minute, clock.second, clock.microsecond // 10_000,
        )  # fmt: skip
        return bytes(leader)

    def _bottom(self, sample: Velocity) -> bytes:
        forward, right, down = (round(1000 * value) for value in sample.velocity_m_s)
        track = bytearray(BOTTOM_BYTES)
        centimetres = round(self._altitude_m * 100)
        struct.pack_into("<H", track, 0, 0x0600)
        struct.pack_into("<4H", track, 16, *[centimetres & 0xFFFF] * 4)
        struct.pack_into("<4h", track, 24, -right, -forward, down, 0)
        track[77:81] = bytes([centimetres >> 16] * 4)
        return bytes(track)


def ensemble(*parts: bytes) -> bytes:
    """Parts behind a header that says where each begins, and the sum of all bytes."""
    first = 6 + 2 * len(parts)
    offsets = [first + sum(map(len, parts[:k])) for k in range(len(parts))]
    size = first + sum(map(len, parts))
    header = struct.pack(f"<HHBB{len(parts)}H", 0x7F7F, size, 0, len(parts), *offsets)
    body = header + b"".join(parts)
    return body + struct.pack("<H", sum(body) % 65536)
