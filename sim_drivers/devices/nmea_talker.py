"""An integrated instrument that speaks NMEA 0183."""

from __future__ import annotations

import math
from functools import reduce

from aquaflow.messages import Altitude, AngularRate, Attitude, Depth, TelemetrySample, Velocity
from sim_drivers.devices.device import OneWayDevice
from sim_drivers.devices.waterlinked import euler_deg

KNOT_M_S = 1852.0 / 3600.0
"""m/s; a nautical mile of 1852 m in an hour."""


def sentence(body: str) -> bytes:
    """With its checksum, the exclusive or of all characters."""
    checksum = reduce(lambda sofar, byte: sofar ^ byte, body.encode(), 0)
    return f"${body}*{checksum:02X}\r\n".encode()


class NmeaTalker(OneWayDevice[bytes]):
    """Attitude as PRDID and HDT, altitude as DBT and DPT, depth as DBS, yaw rate as ROT, velocity
    as VBW."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        match sample:
            case Attitude():
                roll, pitch, yaw = euler_deg(sample)
                heading = yaw % 360.0
                return [
                    sentence(f"PRDID,{pitch:.3f},{roll:.3f},{heading:.3f}"),
                    sentence(f"IIHDT,{heading:.3f},T"),
                ]
            case Altitude():
                metres = sample.altitude_m
                return [
                    sentence(f"SDDBT,{_lengths(metres)}"),
                    sentence(f"SDDPT,{metres:.2f},0.50,100.0"),
                ]
            case Depth():
                return [sentence(f"SDDBS,{_lengths(sample.depth_m)}")]
            case AngularRate():
                degrees_per_minute = math.degrees(sample.rate_rad_s[2]) * 60.0
                return [sentence(f"HEROT,{degrees_per_minute:.2f},A")]
            case Velocity():
                forward, right = (value / KNOT_M_S for value in sample.velocity_m_s[:2])
                return [sentence(f"VDVBW,,,V,{forward:.4f},{right:.4f},A")]
        return []


def _lengths(metres: float) -> str:
    return f"{metres / 0.3048:.2f},f,{metres:.2f},M,{metres / 1.8288:.2f},F"
