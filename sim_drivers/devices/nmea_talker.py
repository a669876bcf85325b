"""An integrated instrument that speaks NMEA 0183."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from functools import reduce

from aquaflow.sim_drivers.devices.device import OneWayDevice
from aquaflow.sim_drivers.devices.waterlinked import euler_deg
from aquaflow.types import (
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)

KNOT_M_S = 1852.0 / 3600.0
"""m/s; a nautical mile of 1852 m in an hour."""

CLOCK = "120000.00"
"""Time of every fix; the driver does not read it."""


def sentence(body: str) -> bytes:
    """The sentence with its checksum, the exclusive or of all characters."""
    checksum = reduce(lambda sofar, byte: sofar ^ byte, body.encode(), 0)
    return f"${body}*{checksum:02X}\r\n".encode()


class NmeaTalker(OneWayDevice[bytes]):
    """Attitude as PRDID and HDT, altitude as DBT and DPT, depth as DBS, yaw rate as ROT, velocity
    as VBW, position as GST and GGA, UTC as ZDA."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        return [sentence(body) for body in _bodies(sample)]


def _bodies(sample: TelemetrySample) -> list[str]:
    """What stands between the mark and the checksum."""
    bodies: list[str] = []
    match sample:
        case Attitude():
            roll, pitch, yaw = euler_deg(sample)
            heading = yaw % 360.0
            bodies = [f"PRDID,{pitch:.3f},{roll:.3f},{heading:.3f}", f"IIHDT,{heading:.3f},T"]
        case Altitude():
            metres = sample.altitude_m
            bodies = [f"SDDBT,{_lengths(metres)}", f"SDDPT,{metres:.2f},0.50,100.0"]
        case Depth():
            bodies = [f"SDDBS,{_lengths(sample.depth_m)}"]
        case AngularRate():
            degrees_per_minute = math.degrees(sample.rate_rad_s[2]) * 60.0
            bodies = [f"HEROT,{degrees_per_minute:.2f},A"]
        case Velocity():
            forward, right = (value / KNOT_M_S for value in sample.velocity_m_s[:2])
            bodies = [f"VDVBW,,,V,{forward:.4f},{right:.4f},A"]
        case Position():
            latitude = _angle(sample.latitude_deg, "NS", 2)
            longitude = _angle(sample.longitude_deg, "EW", 3)
            sigma = f"{sample.sigma_m:.3f}"
            bodies = [
                f"GPGST,{CLOCK},{sigma},,,,{sigma},{sigma},",
                f"GPGGA,{CLOCK},{latitude},{longitude},1,08,1.6,0.0,M,0.0,M,,",
            ]
        case UtcTime():
            seconds, fraction = divmod(sample.utc_ns, 1_000_000_000)
            moment = datetime.fromtimestamp(seconds, timezone.utc)
            clock = f"{moment:%H%M%S}.{fraction // 10_000_000:02d}"
            bodies = [f"GPZDA,{clock},{moment:%d,%m,%Y},00,00"]
    return bodies


def _angle(degrees: float, hemispheres: str, digits: int) -> str:
    """``ddmm.mmmmmmm`` and the hemisphere."""
    whole, part = divmod(abs(degrees), 1.0)
    return f"{int(whole):0{digits}d}{60.0 * part:010.7f},{hemispheres[degrees < 0.0]}"


def _lengths(metres: float) -> str:
    return f"{metres / 0.3048:.2f},f,{metres:.2f},M,{metres / 1.8288:.2f},F"
