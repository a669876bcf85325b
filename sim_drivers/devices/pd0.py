"""A Teledyne DVL that sends PD0 ensembles, in ship, beam or earth coordinates."""

from __future__ import annotations

import math
import struct
from datetime import datetime, timedelta, timezone
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.sim_drivers.devices.device import OneWayDevice
from aquaflow.types import Altitude, Attitude, TelemetrySample, Velocity

COORDINATES = {"beam": 0 << 3, "ship": 2 << 3, "earth": 3 << 3 | 4}
"""Byte 25 of the fixed leader; in earth axes the tilts are used."""
CONFIGURATION = 0x424B
"""600 kHz, convex, down, 30 degrees, four beams in Janus arrangement."""
BEAM_DEG = 30.0
"""From the head's axis."""
BEAMS = {"port": (-1, 0), "starboard": (1, 0), "bow": (0, 1), "stern": (0, -1)}
"""Where beams 1 to 4 lean, of a head that looks down: starboard and forward."""
FIXED_BYTES, VARIABLE_BYTES, BOTTOM_BYTES = 58, 77, 81
"""Lengths of the fixed leader, the variable leader and the bottom track, as far as they are
read."""
EPOCH = datetime(2026, 1, 1, tzinfo=timezone.utc)
"""Where the real time clock stood when the device was switched on."""


class Pd0Dvl(OneWayDevice[bytes]):
    """Velocity of the bottom past the instrument, with the last altitude in all four beams, and
    heading, pitch and roll of the last attitude."""

    def __init__(self, coordinates: Literal["ship", "beam", "earth"] = "ship") -> None:
        self._coordinates = coordinates
        self._altitude_m = 0.0
        self._R_nb = Rotation.identity()
        self._ensemble = 0

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        match sample:
            case Altitude():
                self._altitude_m = sample.altitude_m
            case Attitude():
                self._R_nb = Rotation.from_quat(np.roll(sample.wxyz, -1))
            case Velocity():
                self._ensemble += 1
                return [
                    ensemble(
                        self._fixed_leader(), self._variable(measured_ns), self._bottom(sample)
                    )
                ]
        return []

    def _fixed_leader(self) -> bytes:
        leader = bytearray(FIXED_BYTES)
        struct.pack_into("<H", leader, 4, CONFIGURATION)
        leader[25] = COORDINATES[self._coordinates]
        return bytes(leader)

    def _variable(self, measured_ns: int) -> bytes:
        clock = EPOCH + timedelta(microseconds=measured_ns // 1000)
        leader = bytearray(VARIABLE_BYTES)
        struct.pack_into(
            "<HH7B", leader, 0, 0x0080, self._ensemble % 65536, clock.year - 2000, clock.month,
            clock.day, clock.hour, clock.minute, clock.second, clock.microsecond // 10_000,
        )  # fmt: skip
        yaw, pitch, roll = self._R_nb.as_euler("ZYX")
        tilt = math.atan2(math.tan(pitch), math.cos(roll))  # what a pendulum in the head shows
        angles = (math.degrees(yaw) % 360.0, math.degrees(tilt), math.degrees(roll))
        struct.pack_into("<Hhh", leader, 18, *(round(100.0 * angle) for angle in angles))
        return bytes(leader)

    def _bottom(self, sample: Velocity) -> bytes:
        track = bytearray(BOTTOM_BYTES)
        centimetres = round(self._altitude_m * 100)
        struct.pack_into("<H", track, 0, 0x0600)
        struct.pack_into("<4H", track, 16, *[centimetres & 0xFFFF] * 4)
        told = (
            round(1000.0 * value) for value in self._beam_velocities(np.array(sample.velocity_m_s))
        )
        struct.pack_into("<4h", track, 24, *told)
        track[77:81] = bytes([centimetres >> 16] * 4)
        return bytes(track)

    def _beam_velocities(
        self,
        velocity: npt.NDArray[np.float64],  # [3] m/s, forward, right, down, of the vehicle
    ) -> tuple[float, ...]:
        """Four velocities of the bottom, m/s."""
        if self._coordinates == "earth":
            north, east, down = self._R_nb.apply(velocity)
            return -east, -north, down, 0.0
        forward, right, down = velocity
        if self._coordinates == "ship":
            return -right, -forward, down, 0.0
        out, along = math.sin(math.radians(BEAM_DEG)), math.cos(math.radians(BEAM_DEG))
        leans = np.array([(out * y, out * x, along) for x, y in BEAMS.values()])
        # What the vehicle approaches along a beam comes towards that beam.
        return tuple(float(value) for value in leans @ velocity)


def ensemble(*parts: bytes) -> bytes:
    """Parts behind a header that says where each begins, and the sum of all bytes."""
    first = 6 + 2 * len(parts)
    offsets = [first + sum(map(len, parts[:k])) for k in range(len(parts))]
    size = first + sum(map(len, parts))
    header = struct.pack(f"<HHBB{len(parts)}H", 0x7F7F, size, 0, len(parts), *offsets)
    body = header + b"".join(parts)
    return body + struct.pack("<H", sum(body) % 65536)
