"""Common parts of Water Linked's two protocols (github.com/waterlinked/docs, docs/dvl).

Axes are x forward, y starboard, z down, as the body's; a bracket that points the DVL backwards is
the mounting's business.
"""

from __future__ import annotations

import math

from aquaflow.drivers.rotation import from_euler
from aquaflow.types import Altitude, Attitude, TelemetrySample, Velocity

NO_BOTTOM_M = -1.0
"""Altitude where the DVL sees no bottom."""
MAX_LATENCY_US = 1_000_000
"""A measurement is sent within 0.1 s; a longer delay means that one of its two times is wrong."""


def measured_ns(arrival_ns: int, validity_us: int, transmission_us: int) -> int:
    """The DVL's clock is arbitrary, but the time it reports from measurement to sending is not."""
    latency_us = transmission_us - validity_us
    return arrival_ns - latency_us * 1000 if 0 < latency_us <= MAX_LATENCY_US else arrival_ns


def bottom_track(
    t_ns: int,
    arrival_ns: int,
    source: str,
    velocity: tuple[float, float, float] | None,
    merit: float,
    altitude: float,
) -> list[TelemetrySample]:
    """Velocity, unless the DVL calls it invalid, and altitude, unless it sees no bottom."""
    samples: list[TelemetrySample] = []
    if velocity is not None:
        samples.append(Velocity(t_ns, arrival_ns, source, velocity, merit))
    if altitude > NO_BOTTOM_M:
        samples.append(Altitude(t_ns, arrival_ns, source, altitude))
    return samples


def attitude(arrival_ns: int, source: str, roll: float, pitch: float, yaw: float) -> Attitude:
    """Of the dead reckoning; degrees."""
    angles = (math.radians(value) for value in (roll, pitch, yaw))
    return Attitude(arrival_ns, arrival_ns, source, from_euler(*angles))
