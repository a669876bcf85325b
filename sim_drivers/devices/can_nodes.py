"""Nodes on a CAN bus: NMEA 2000 instruments, and whatever a DBC file describes."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any

from aquaflow.config.telemetry import DbcSignal
from aquaflow.messages import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    TelemetrySample,
    Velocity,
)
from sim_drivers.devices.device import OneWayDevice
from sim_drivers.devices.waterlinked import euler_deg

if TYPE_CHECKING:
    from can import Message

PRIORITY, ADDRESS = 2, 35
"""Of the simulated node on the bus; the driver reads neither."""


class Nmea2000Instruments(OneWayDevice["Message"]):
    """Attitude as 127257 and 127250, yaw rate as 127251, forward speed as 128259, altitude as
    128267."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[Message]:
        match sample:
            case Attitude():
                roll, pitch, yaw = (math.radians(angle) for angle in euler_deg(sample))
                angles = struct.pack("<B3hx", 0xFF, *(round(v * 1e4) for v in (yaw, pitch, roll)))
                heading = round(yaw % math.tau * 1e4)
                true = struct.pack("<BHhhB", 0xFF, heading, 0x7FFF, 0x7FFF, 0xFC)
                return [_group(127257, angles), _group(127250, true)]
            case AngularRate():
                rate = round(sample.rate_rad_s[2] / 3.125e-8)
                return [_group(127251, struct.pack("<Bi3x", 0xFF, rate))]
            case Velocity():
                ground = max(0, round(sample.velocity_m_s[0] * 100))
                return [_group(128259, struct.pack("<BHHBH", 0xFF, 0xFFFF, ground, 0, 0xFFFF))]
            case Altitude():
                metres = round(sample.altitude_m * 100)
                return [_group(128267, struct.pack("<BIhB", 0xFF, metres, 0, 0xFF))]
        return []


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
