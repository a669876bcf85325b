"""A Water Linked DVL on its serial port: lines ``wrz,...*xx`` with a CRC-8."""

from __future__ import annotations

import re

from aquaflow.config.instruments import WaterLinkedSerialConfig
from aquaflow.drivers.protocol.packets import LineFraming, PacketDecoder
from aquaflow.drivers.protocol.waterlinked_json import attitude, bottom_track, measured_ns
from aquaflow.types import TelemetrySample

LONGEST = 512
"""Bytes; a velocity report with covariance has about 200."""
POLYNOMIAL = 0x07
"""Of the CRC-8, x^8 + x^2 + x + 1 (Water Linked's serial protocol)."""
LINE = re.compile(rb"(w[\x20-\x29\x2b-\x7e]*)\*([0-9a-f]{2})[\r\n]")
"""What the CRC covers, and the two digits of it."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte << 1) ^ (POLYNOMIAL if byte & 0x80 else 0)  # noqa: PLW2901
        table.append(byte & 0xFF)
    return tuple(table)


CRC_TABLE = _crc_table()
"""CRC-8 of every byte."""


def crc8(data: bytes) -> int:
    """Polynomial 0x07, start 0, not reflected."""
    crc = 0
    for byte in data:
        crc = CRC_TABLE[crc ^ byte]
    return crc


def _intact(packet: bytes) -> bool:
    match = LINE.fullmatch(packet)
    return match is not None and crc8(match.group(1)) == int(match.group(2), 16)


class WaterLinkedSerialDecoder(PacketDecoder):
    """Reports wrz and (older firmware) wrx, and wrp where its attitude is asked for."""

    def __init__(self, name: str, config: WaterLinkedSerialConfig) -> None:
        super().__init__(name, LineFraming(b"w", LONGEST, _intact))
        self._attitude = config.attitude

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        kind, *fields = packet[: packet.rindex(b"*")].decode("ascii").split(",")
        if kind == "wrz":
            return self._velocity(fields, arrival_ns)
        if kind == "wrx":
            return self._old_velocity(fields, arrival_ns)
        if kind == "wrp" and self._attitude:
            roll, pitch, yaw = map(float, fields[5:8])
            return [attitude(arrival_ns, self.source(kind), roll, pitch, yaw)]
        return []

    def _velocity(self, fields: list[str], arrival_ns: int) -> list[TelemetrySample]:
        """vx, vy, vz, valid, altitude, merit, covariance, validity, transmission, time, status."""
        t_ns = measured_ns(arrival_ns, int(fields[7]), int(fields[8]))
        merit = float(fields[5])
        return bottom_track(
            t_ns, arrival_ns, self.source("wrz"), self._vector(fields[0:3], fields[3]), merit,
            float(fields[4]),
        )  # fmt: skip

    def _old_velocity(self, fields: list[str], arrival_ns: int) -> list[TelemetrySample]:
        """time, vx, vy, vz, merit, altitude, valid, status."""
        merit = float(fields[4])
        return bottom_track(
            arrival_ns, arrival_ns, self.source("wrx"), self._vector(fields[1:4], fields[6]), merit,
            float(fields[5]),
        )  # fmt: skip

    def _vector(self, fields: list[str], valid: str) -> tuple[float, float, float] | None:
        if valid != "y":
            self.counters.invalid_values += 1
            return None
        x, y, z = map(float, fields)
        return (x, y, z)
