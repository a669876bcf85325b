"""A Nortek Nucleus (DVL, altimeter, AHRS, IMU, pressure) by its binary packets.

Layouts, login and commands as Nortek's nucleus_driver has them (MIT, github.com/NortekSupport,
version 1.7.8). Axes are x forward, y starboard, z down.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

from aquaflow.config.instruments import NucleusConfig
from aquaflow.drivers.link import DeviceClock
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.drivers.samples import from_euler
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    TelemetrySample,
    Velocity,
)

MARK = 0xA5
HEADER = struct.Struct("<BBBBHHH")
"""Mark, length of the header, packet, family, length of the data, their checksum, that of the
header."""
FAMILY = 0x20
"""Of the Nucleus."""
LONGEST = HEADER.size + 8192
"""Bytes; the longest packet is a current profile."""
SEED = 0xB58C
"""Of the checksums."""
IMU, FAST_PRESSURE, ALTIMETER, BOTTOM_TRACK, AHRS = 0x82, 0x96, 0xAA, 0xB4, 0xD2
"""Packets that are read."""
COMMON = struct.Struct("<BBBxIII")
"""Version, where the values begin, flags, seconds, microseconds, status: first of all data."""
VALID = 0x01
"""Status of the IMU and of the altimeter's distance."""
VELOCITY_VALID, MERIT_VALID = 0x0E00, 0x7000
"""Status of x, y and z of the bottom track, and of their figures of merit."""
TRACK_AT, DISTANCE_AT, DEPTH_AT = 96, 36, 68
"""Where the velocities stand in the bottom track, the distance in the altimeter's data, and, behind
the beginning of the values, the depth in those of the AHRS."""
DECIBAR_PA = 10_000.0
GRAVITY_M_S2 = 9.80665
"""Standard gravity, which turns pressure into depth."""
PROMPT = b"enter password:"
"""What it says first on TCP."""
PATIENCE_NS = 3_000_000_000
"""An instrument that has sent no packet for so long is told to start; it measures once a second at
least."""

Values: TypeAlias = Callable[[str, int], tuple[float, ...]]
"""Unpacks from behind the beginning of the values."""


class NucleusTime(NamedTuple):
    """The first three fields of every sample."""

    t_ns: int
    arrival_ns: int
    source: str


Convert: TypeAlias = Callable[[bytes, Values, int, NucleusTime], list[TelemetrySample]]


class NucleusFraming(Framing):
    """Header with a checksum of its own, then data."""

    longest = LONGEST

    def find(self, buffer: bytes, at: int) -> int:
        return buffer.find(MARK, at)

    def length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < HEADER.size:
            return INCOMPLETE
        _, header, _, family, size, _, sent = HEADER.unpack_from(buffer, at)
        whole = header == HEADER.size and family == FAMILY and header + size <= LONGEST
        if not whole or checksum(buffer[at : at + HEADER.size - 2]) != sent:
            return NO_PACKET
        return int(header + size)

    def intact(self, packet: bytes) -> bool:
        return checksum(packet[HEADER.size :]) == int(HEADER.unpack_from(packet)[5])


class NucleusDecoder(PacketDecoder):
    """Velocity, altitude, attitude, depth, rates and acceleration; login and start."""

    def __init__(self, name: str, config: NucleusConfig) -> None:
        super().__init__(name, NucleusFraming())
        self.clock: DeviceClock = DeviceClock(name)
        self._config = config
        self._said = self._answer = b""
        self._start_at_ns: int | None = None
        known: dict[str, tuple[int, Convert]] = {
            "bottom_track": (BOTTOM_TRACK, self._bottom_track),
            "altimeter": (ALTIMETER, self._altimeter),
            "ahrs": (AHRS, self._ahrs),
            "imu": (IMU, self._imu),
            "fast_pressure": (FAST_PRESSURE, self._fast_pressure),
        }
        self._packets = {known[name][0]: (name, known[name][1]) for name in config.packets}

    def feed(self, data: bytes, arrival_ns: int) -> list[TelemetrySample]:
        before = self.counters.messages
        samples = super().feed(data, arrival_ns)
        if self.counters.messages > before:
            self._start_at_ns, self._said = arrival_ns + PATIENCE_NS, b""
            return samples
        self._said = (self._said + data)[-4 * len(PROMPT) :]
        if PROMPT in self._said:
            self._said, self._answer = b"", self._config.password.encode() + b"\r\n"
        return samples

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        wanted = self._packets.get(packet[2])
        if wanted is None:
            return []
        name, convert = wanted
        data = packet[HEADER.size :]
        _, begin, _, seconds, microseconds, status = COMMON.unpack_from(data)
        t_ns = self.clock.stamp(seconds * 10**9 + microseconds * 1000, arrival_ns)
        values = partial(_unpack, data, begin)
        return convert(data, values, status, NucleusTime(t_ns, arrival_ns, self.source(name)))

    def outgoing(self, now_ns: int) -> bytes:
        """The password where it was asked for, and the command to start, if it is due."""
        said, self._answer = self._answer, b""
        if self._start_at_ns is None:
            self._start_at_ns = now_ns + PATIENCE_NS
        if self._config.start and now_ns >= self._start_at_ns:
            self._start_at_ns = now_ns + PATIENCE_NS
            said += b"START\r\n"
        return said

    def reset(self) -> None:
        super().reset()
        self._said, self._start_at_ns = b"", None

    def _bottom_track(
        self, data: bytes, values: Values, status: int, stamp: NucleusTime
    ) -> list[TelemetrySample]:
        if status & VELOCITY_VALID != VELOCITY_VALID or status & MERIT_VALID != MERIT_VALID:
            raise ValueError("the bottom track is invalid")
        vx, vy, vz, *merits = struct.unpack_from("<6f", data, TRACK_AT)
        return [Velocity(*stamp, (vx, vy, vz), max(merits))]

    def _altimeter(
        self, data: bytes, values: Values, status: int, stamp: NucleusTime
    ) -> list[TelemetrySample]:
        if not status & VALID:
            raise ValueError("the altimeter sees no bottom")
        return [Altitude(*stamp, float(struct.unpack_from("<f", data, DISTANCE_AT)[0]))]

    def _ahrs(
        self, data: bytes, values: Values, status: int, stamp: NucleusTime
    ) -> list[TelemetrySample]:
        roll, pitch, heading = (math.radians(angle) for angle in values("<3f", 0))
        samples: list[TelemetrySample] = [Attitude(*stamp, from_euler(roll, pitch, heading))]
        if FAST_PRESSURE not in self._packets:
            samples.append(Depth(*stamp, values("<f", DEPTH_AT)[0]))
        return samples

    def _imu(
        self, data: bytes, values: Values, status: int, stamp: NucleusTime
    ) -> list[TelemetrySample]:
        if not status & VALID:
            raise ValueError("the IMU is invalid")
        ax, ay, az, wx, wy, wz = values("<6f", 0)
        return [Acceleration(*stamp, (ax, ay, az)), AngularRate(*stamp, (wx, wy, wz))]

    def _fast_pressure(
        self, data: bytes, values: Values, status: int, stamp: NucleusTime
    ) -> list[TelemetrySample]:
        over_surface_pa = values("<f", 0)[0] * DECIBAR_PA - self._config.surface_pressure_pa
        depth_m = over_surface_pa / (self._config.water_density_kg_m3 * GRAVITY_M_S2)
        return [Depth(*stamp, depth_m)]


def checksum(data: bytes) -> int:
    """Sum of 16 bit words, little endian; a last odd byte is the upper half of one."""
    words = struct.unpack_from(f"<{len(data) // 2}H", data)
    odd = data[-1] << 8 if len(data) % 2 else 0
    return (SEED + int(sum(words)) + odd) & 0xFFFF


def _unpack(data: bytes, begin: int, code: str, at: int) -> tuple[float, ...]:
    return struct.unpack_from(code, data, begin + at)
