"""Nodes on a CAN bus: NMEA 2000 instruments, and whatever a DBC file describes."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any

from aquaflow.config.instruments import DbcSignal
from aquaflow.sim_drivers.devices.device import OneWayDevice
from aquaflow.sim_drivers.devices.waterlinked import euler_deg
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)

if TYPE_CHECKING:
    from can import Message

PRIORITY, ADDRESS = 2, 35
"""Of the simulated node on the bus; the driver reads neither."""
THREE_D = 0b11_010_010
"""Modes in 129539: 3D wanted and reached, and two bits that are not used."""


class Nmea2000Instruments(OneWayDevice["Message"]):
    """Attitude as 127257 and 127250, yaw rate as 127251, forward speed as 128259, altitude as
    128267, position as 129539 and 129025, UTC as 126992."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[Message]:
        return [_group(number, data) for number, data in _groups(sample)]


def _groups(sample: TelemetrySample) -> list[tuple[int, bytes]]:
    """Parameter groups that state the sample."""
    groups: list[tuple[int, bytes]] = []
    match sample:
        case Attitude():
            roll, pitch, yaw = (math.radians(angle) for angle in euler_deg(sample))
            angles = struct.pack("<B3hx", 0xFF, *(round(v * 1e4) for v in (yaw, pitch, roll)))
            heading = round(yaw % math.tau * 1e4)
            true = struct.pack("<BHhhB", 0xFF, heading, 0x7FFF, 0x7FFF, 0xFC)
            groups = [(127257, angles), (127250, true)]
        case AngularRate():
            rate = round(sample.rate_rad_s[2] / 3.125e-8)
            groups = [(127251, struct.pack("<Bi3x", 0xFF, rate))]
        case Velocity():
            ground = max(0, round(sample.velocity_m_s[0] * 100))
            groups = [(128259, struct.pack("<BHHBH", 0xFF, 0xFFFF, ground, 0, 0xFFFF))]
        case Altitude():
            metres = round(sample.altitude_m * 100)
            groups = [(128267, struct.pack("<BIhB", 0xFF, metres, 0, 0xFF))]
        case Position():
            place = round(sample.latitude_deg * 1e7), round(sample.longitude_deg * 1e7)
            dilution = struct.pack("<BBhhh", 0xFF, THREE_D, 160, 0x7FFF, 0x7FFF)
            groups = [(129539, dilution), (129025, struct.pack("<ii", *place))]
        case UtcTime():
            days, since = divmod(sample.utc_ns, 86_400_000_000_000)
            groups = [(126992, struct.pack("<BBHI", 0xFF, 0xF0, days, since // 100_000))]
    return groups


class DbcNode(OneWayDevice["Message"]):
    """Sends samples in the messages that ``mappings`` name; their scale is undone."""

    def __init__(self, database: str, mappings: tuple[DbcSignal, ...]) -> None:
        import cantools

        loaded: Any = cantools.database.load_file(database)
        self._messages = [(loaded.get_message_by_name(m.message), m) for m in mappings]

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[Message]:
        import can

        values = _values(sample)
        return [
            can.Message(
                arbitration_id=message.frame_id,
                is_extended_id=message.is_extended_frame,
                data=message.encode(_signals(mapping, values[mapping.sample]), strict=False),
            )
            for message, mapping in self._messages
            if mapping.sample in values
        ]


def _values(sample: TelemetrySample) -> dict[str, tuple[float, ...]]:
    """The sample's values under each name that a mapping may have for it."""
    values: dict[str, tuple[float, ...]]
    match sample:
        case Depth():
            values = {"depth": (sample.depth_m,)}
        case Altitude():
            values = {"altitude": (sample.altitude_m,)}
        case Lights():
            values = {"lights": (sample.level,)}
        case Velocity():
            values = {"velocity": sample.velocity_m_s}
        case AngularRate():
            values = {"angular_rate": sample.rate_rad_s}
        case Acceleration():
            values = {"acceleration": sample.acceleration_m_s2}
        case Position():
            values = {"position": (sample.latitude_deg, sample.longitude_deg)}
        case UtcTime():
            values = {}
        case Attitude():
            roll, pitch, yaw = (math.radians(angle) for angle in euler_deg(sample))
            values = {"attitude": sample.wxyz, "euler": (roll, pitch, yaw)}
    return values


def _signals(mapping: DbcSignal, values: tuple[float, ...]) -> dict[str, float]:
    scale = mapping.scale * (len(values) // len(mapping.scale))
    return {
        name: value / factor
        for name, value, factor in zip(mapping.signals, values, scale, strict=True)
    }


def _group(number: int, data: bytes) -> Message:
    import can

    identifier = PRIORITY << 26 | number << 8 | ADDRESS
    return can.Message(arbitration_id=identifier, is_extended_id=True, data=data)
