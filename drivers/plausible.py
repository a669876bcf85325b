"""Limits of plausible measurements: samples beyond are counted and dropped."""

from __future__ import annotations

import math

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

DEPTH_M = (-20.0, 11_500.0)
"""Above the surface only by a wrong surface pressure; the deepest sea is 10,935 m."""
MAX_ALTITUDE_M = 11_500.0
"""No further above ground than the deepest sea is deep."""
MAX_SPEED_M_S = 20.0
"""The fastest vehicles do 10 m/s."""
MAX_RATE_RAD_S = 40.0
"""Gyros saturate at 2000 deg/s = 35 rad/s."""
MAX_ACCELERATION_M_S2 = 320.0
"""MAVLink's 16 bit milli-g end at 321 m/s^2."""
UTC_S = (946_684_800, 4_102_444_800)
"""Seconds since 1970 of the years 2000 to 2100: a receiver without satellites says 1980 or 1970."""
NORM_TOLERANCE = 0.1
"""A quaternion further from length 1 was damaged on its way."""


def plausible(sample: TelemetrySample) -> bool:
    """False for values that are not finite or that no vehicle can have; a NaN fails every test."""
    if isinstance(sample, Attitude):
        return abs(math.hypot(*sample.wxyz) - 1.0) <= NORM_TOLERANCE
    if isinstance(sample, Velocity) and not 0.0 <= sample.figure_of_merit_m_s < math.inf:
        return False
    if isinstance(sample, Position):
        return _on_earth(sample)
    if isinstance(sample, UtcTime):
        return UTC_S[0] <= sample.utc_ns * 1e-9 <= UTC_S[1]
    values, low, high = _limits(sample)
    return all(low <= value <= high for value in values)


def _on_earth(fix: Position) -> bool:
    """Latitude and longitude 0, 0 is what a receiver without a fix sends."""
    inside = abs(fix.latitude_deg) <= 90.0 and abs(fix.longitude_deg) <= 180.0
    somewhere = fix.latitude_deg != 0.0 or fix.longitude_deg != 0.0
    return inside and somewhere and 0.0 < fix.sigma_m < math.inf


def _limits(
    sample: Depth | AngularRate | Acceleration | Velocity | Altitude | Lights,
) -> tuple[tuple[float, ...], float, float]:
    match sample:
        case Depth():
            return (sample.depth_m,), *DEPTH_M
        case Altitude():
            return (sample.altitude_m,), 0.0, MAX_ALTITUDE_M
        case Lights():
            return (sample.level,), 0.0, 1.0
        case Velocity():
            return sample.velocity_m_s, -MAX_SPEED_M_S, MAX_SPEED_M_S
        case AngularRate():
            return sample.rate_rad_s, -MAX_RATE_RAD_S, MAX_RATE_RAD_S
        case Acceleration():
            return sample.acceleration_m_s2, -MAX_ACCELERATION_M_S2, MAX_ACCELERATION_M_S2
