"""A Nortek Nucleus1000: packets as Nortek's own parser reads them, login and START on request."""

from __future__ import annotations

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.sim_drivers.devices.waterlinked import euler_deg
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    TelemetrySample,
    Velocity,
)

ALL_VALID = 0x7FFF
"""Status of a bottom track whose beams and axes are all good."""
PROMPT = b"\r\nPlease enter password:\r\n"
ASK_NS = 500_000_000
"""So that a client that connects late is asked too."""


class Nucleus:
    """Attitude as AHRS with the last depth, angular rate as IMU with the last specific force,
    velocity as bottom track, altitude as altimeter, depth as fast pressure too."""

    def __init__(self, password: str | None = None, measures: bool = True) -> None:
        """``password``: asked for, as on TCP; ``measures``: it was started before."""
        self.password, self.measures = password, measures
        self.commands: list[bytes] = []
        """Lines that were heard."""
        self._depth_m = 0.0
        self._force = (0.0, 0.0, -9.8)
        self._asked_ns: int | None = None
        self._heard = b""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        if self.password is not None or not self.measures:
            return []
        return self._packets(sample, measured_ns // 1000)

    def answer(self, packet: bytes, now_ns: int) -> list[bytes]:
        *lines, self._heard = (self._heard + packet).split(b"\r\n")
        return [answer for line in lines for answer in self._answer(line)]

    def due_packets(self, now_ns: int) -> list[bytes]:
        if self.password is None or (self._asked_ns and now_ns - self._asked_ns < ASK_NS):
            return []
        self._asked_ns = now_ns
        return [PROMPT]

    def _answer(self, line: bytes) -> list[bytes]:
        self.commands.append(line)
        if self.password is not None:
            if line != self.password.encode():
                return [b"Wrong password\r\n"]
            self.password = None
            return [b"Welcome to Nortek Nucleus1000\r\n"]
        if line == b"START":
            self.measures = True
            return [b"OK\r\n"]
        return [b"ERROR\r\n"]

    def _packets(self, sample: TelemetrySample, us: int) -> list[bytes]:
        packets: list[bytes] = []
        match sample:
            case Acceleration():
                self._force = sample.acceleration_m_s2
            case AngularRate():
                values = struct.pack("<7f", *self._force, *sample.rate_rad_s, 21.5)
                packets = [packet(0x82, us, 1, b"", values)]
            case Attitude():
                packets = [packet(0xD2, us, 0, bytes(20), self._ahrs(sample), version=2)]
            case Velocity():
                packets = [packet(0xB4, us, ALL_VALID, _track(sample), b"")]
            case Altitude():
                rest = struct.pack("<4xffff", 1500.0, 12.5, 11.1, sample.altitude_m)
                packets = [packet(0xAA, us, 3, b"SN  " + rest, struct.pack("<H", 9000))]
            case Depth():
                self._depth_m = sample.depth_m
                decibar = (101_325.0 + sample.depth_m * 1029.0 * 9.80665) / 10_000.0
                packets = [packet(0x96, us, 1, b"", struct.pack("<f", decibar))]
        return packets

    def _ahrs(self, sample: Attitude) -> bytes:
        roll, pitch, heading = euler_deg(sample)
        turn = Rotation.from_quat(np.roll(sample.wxyz, -1)).as_matrix().ravel()
        return struct.pack(
            "<18f", roll, pitch, heading % 360.0, *sample.wxyz, *turn, 0.0, self._depth_m
        )


def _track(sample: Velocity) -> bytes:
    """What stands between status and end of a bottom track."""
    beams = (0.1, 0.2, 0.3, 2.0, 2.1, 2.2, *[0.01] * 3, *[0.003] * 3, *[0.002] * 3)
    merits = [sample.figure_of_merit_m_s] * 3
    values = (1500.0, 12.5, 11.1, *beams, *sample.velocity_m_s, *merits, 0.003, 0.002)
    return b"SN  " + bytes(4) + struct.pack(f"<{len(values)}f", *values)


def packet(
    number: int, us: int, status: int, fixed: bytes, values: bytes, version: int = 1
) -> bytes:
    """A packet of the Nucleus' family: ``values`` begin behind the ``fixed`` part."""
    begin = 16 + len(fixed)
    seconds, rest = divmod(us, 1_000_000)
    data = struct.pack("<BBBBIII", version, begin, 0, 0, seconds, rest, status) + fixed + values
    header = struct.pack("<BBBBHH", 0xA5, 10, number, 0x20, len(data), sum_words(data))
    return header + struct.pack("<H", sum_words(header)) + data


def sum_words(data: bytes) -> int:
    """Nortek's checksum: words added to 0xB58C, an odd byte as the upper half of a word."""
    total = 0xB58C
    for at in range(0, len(data) - 1, 2):
        total += data[at] + 256 * data[at + 1]
    if len(data) % 2:
        total += 256 * data[-1]
    return total % 65536
