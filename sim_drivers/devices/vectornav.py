"""A VectorNav INS, as the VN-100's and VN-200's user manuals describe it."""

from __future__ import annotations

import struct
from datetime import datetime, timezone
from functools import reduce
from typing import TypeAlias

import numpy as np

from aquaflow.sim_drivers.devices.device import OneWayDevice
from aquaflow.sim_drivers.devices.waterlinked import euler_deg
from aquaflow.types import Acceleration, AngularRate, Attitude, Position, TelemetrySample, UtcTime

TRACKING = 0b110
"""Status of a filter that tracks, with a fix of its receiver."""
Groups: TypeAlias = dict[int, dict[int, bytes]]
"""Values by group (from 1) and bit."""


class VectorNav(OneWayDevice[bytes]):
    """Attitude as quaternion, angular rate with the last specific force, position and UTC, each in
    a binary message of its own; or as VNYMR, VNINS and the like."""

    def __init__(self, ascii_messages: bool = False) -> None:
        self._ascii = ascii_messages
        self._force = (0.0, 0.0, -9.8)
        self._angles = "+000.0000,+000.0000,+000.0000"

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        if isinstance(sample, Acceleration):
            self._force = sample.acceleration_m_s2
        if self._ascii:
            return [line(body) for body in self._bodies(sample)]
        groups = self._groups(sample)
        startup = struct.pack("<Q", measured_ns)
        if groups:
            groups[1] = {0: startup, **groups.get(1, {})}
        return [binary(groups)] if groups else []

    def _groups(self, sample: TelemetrySample) -> Groups:
        groups: Groups = {}
        match sample:
            case Attitude():
                w, x, y, z = sample.wxyz
                groups = {5: {2: struct.pack("<4f", x, y, z, w)}}
            case AngularRate():
                groups = {
                    3: {
                        9: struct.pack("<3f", *self._force),
                        10: struct.pack("<3f", *sample.rate_rad_s),
                    }
                }
            case Position():
                place = struct.pack("<3d", sample.latitude_deg, sample.longitude_deg, -12.0)
                sigma = struct.pack("<f", sample.sigma_m)
                groups = {6: {0: struct.pack("<H", TRACKING), 1: place, 9: sigma}}
            case UtcTime():
                groups = {2: {6: _utc(sample), 9: b"\x07"}}
        return groups

    def _bodies(self, sample: TelemetrySample) -> list[str]:
        """What stands between the mark and the checksum."""
        bodies: list[str] = []
        match sample:
            case Attitude():
                roll, pitch, yaw = euler_deg(sample)
                self._angles = f"{yaw:+09.4f},{pitch:+09.4f},{roll:+09.4f}"
                bodies = [f"VNYPR,{self._angles}"]
            case AngularRate():
                force, rate = (_sentence(each) for each in (self._force, sample.rate_rad_s))
                magnetic = _sentence((1.0, 0.1, 0.5))
                bodies = [f"VNIMU,{magnetic},{force},{rate},+21.5,+101.325"]
            case Position():
                place = f"{sample.latitude_deg:+013.9f},{sample.longitude_deg:+014.9f}"
                bodies = [
                    f"VNINS,333811.902862,1694,{TRACKING:04X},{self._angles},{place},"
                    f"+00171.195,-000.840,-000.396,-000.109,07.8,{sample.sigma_m:.3f},0.23"
                ]
        return bodies


def _utc(sample: UtcTime) -> bytes:
    seconds, rest_ns = divmod(sample.utc_ns, 10**9)
    at = datetime.fromtimestamp(seconds, timezone.utc)
    date = (at.year - 2000, at.month, at.day, at.hour, at.minute, at.second)
    return struct.pack("<b5BH", *date, rest_ns // 10**6)


def _sentence(values: tuple[float, ...]) -> str:
    return ",".join(f"{value:+010.6f}" for value in values)


def binary(groups: Groups) -> bytes:
    """A binary message: groups and fields in the order of their numbers, and a CRC."""
    numbers = sorted(groups)
    masks = [sum(1 << bit for bit in groups[number]) for number in numbers]
    header = bytes([sum(1 << (number - 1) for number in numbers)])
    header += struct.pack(f"<{len(masks)}H", *masks)
    values = b"".join(groups[n][bit] for n in numbers for bit in sorted(groups[n]))
    return b"\xfa" + header + values + crc(header + values).to_bytes(2, "big")


def line(body: str, wide: bool = False) -> bytes:
    """An ASCII message with its checksum, or ``wide`` with its CRC."""
    if wide:
        return f"${body}*{crc(body.encode()):04X}\r\n".encode()
    return f"${body}*{reduce(np.bitwise_xor, body.encode(), 0):02X}\r\n".encode()


def crc(data: bytes) -> int:
    """CRC16-CCITT: polynomial 0x1021, start 0."""
    register = 0
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1 ^ 0x1021) if register & 0x8000 else register << 1
        register &= 0xFFFF
    return register
