"""What decoders make of numbers: fixes on the earth, limits, rotations, partial measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

from aquaflow.config.stage import Assumptions, PositioningConfig
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

UERE_M = 5.1
"""m, 1 sigma of a range to a satellite, single frequency without corrections: B. Parkinson, "GPS
Error Analysis", in Global Positioning System: Theory and Applications I (1996), table 2."""
USUAL_HDOP = 2.0
"""HDOP of a fix that states none; that of the same table."""
ARM_LATITUDE_DEG = 89.9
"""Nearer to a pole a lever arm has no east."""
EQUATOR_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS 84."""


def sigma_of(hdop: float | None) -> float:
    """1 sigma of each horizontal direction, m: HDOP times UERE is that of both together. None or 0:
    not stated."""
    return (hdop or USUAL_HDOP) * UERE_M / math.sqrt(2.0)


class Fixes:
    """The fixes of one device, as its config says.

    Acoustic systems, and the programs between them and a vehicle, send the last fix again while
    there is no newer one, as if it were new. A place that equals the one before to the last digit
    is taken for that; it would hold a moving vehicle back.
    """

    def __init__(self, config: PositioningConfig) -> None:
        self._lag_ns = round(config.position_lag_s * 1e9)
        self._sigma_m = config.position_sigma_m
        self._last: dict[str, tuple[float, float]] = {}

    def date(self, t_ns: int) -> int:
        """When what the device dates ``t_ns`` was measured."""
        return t_ns - self._lag_ns

    def fix(
        self,
        t_ns: int,
        arrival_ns: int,
        source: str,
        latitude_deg: float,
        longitude_deg: float,
        sigma_m: float,
    ) -> list[TelemetrySample]:
        """The sample of a fix that the device dates ``t_ns`` and calls accurate to ``sigma_m``;
        none if it is the fix before."""
        place = (latitude_deg, longitude_deg)
        if self._last.get(source) == place:
            return []
        self._last[source] = place
        t_ns, sigma_m = self.date(t_ns), self._sigma_m or sigma_m
        return [Position(t_ns, arrival_ns, source, *place, sigma_m)]


def move(fix: Position, north_m: float, east_m: float) -> Position:
    """The fix of a point that lies ``north_m`` and ``east_m`` away, a few metres at most."""
    if abs(fix.latitude_deg) > ARM_LATITUDE_DEG:
        return fix
    latitude = math.radians(fix.latitude_deg)
    e2 = FLATTENING * (2.0 - FLATTENING)
    w2 = 1.0 - e2 * math.sin(latitude) ** 2
    transverse_m = EQUATOR_M / math.sqrt(w2)
    meridian_m = transverse_m * (1.0 - e2) / w2
    east = math.degrees(east_m / (transverse_m * math.cos(latitude)))
    longitude_deg = (fix.longitude_deg + east + 180.0) % 360.0 - 180.0
    latitude_deg = fix.latitude_deg + math.degrees(north_m / meridian_m)
    return replace(fix, latitude_deg=latitude_deg, longitude_deg=longitude_deg)


# --------------------------------------------------------------------------------------------------
# Limits of plausible measurements: samples beyond are counted and dropped.

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


# --------------------------------------------------------------------------------------------------
# Rotations of single samples; quaternions wxyz, plain floats, since one sample is no array.

Quaternion: TypeAlias = tuple[float, float, float, float]
Vector: TypeAlias = tuple[float, float, float]


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Body in NED: turned by yaw, then pitch, then roll, as MAVLink, NMEA and DVLs mean them."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def normalise(q: Quaternion) -> Quaternion:
    """Raises ZeroDivisionError for the zero quaternion."""
    norm = math.sqrt(sum(value * value for value in q))
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """First ``b``, then ``a``."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def inverse(q: Quaternion) -> Quaternion:
    """Of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def rotate(q: Quaternion, v: Vector) -> Vector:
    """``v`` turned by the unit quaternion ``q``."""
    t = cross(q[1:], v)
    u = cross(q[1:], t)
    return (
        v[0] + 2 * (q[0] * t[0] + u[0]),
        v[1] + 2 * (q[0] * t[1] + u[1]),
        v[2] + 2 * (q[0] * t[2] + u[2]),
    )


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


# --------------------------------------------------------------------------------------------------
# Attitude and velocity from instruments that measure only a part of them.

TILT_LIFE_NS = 500_000_000
"""Roll and pitch older than this are not used: an ROV rocks within a second."""


class PartialMotion:
    """Completes one instrument's values from the others on its link or from ``assume``.

    What stays unknown makes no sample: a heading that pretended to know roll and pitch would turn
    gravity.
    """

    def __init__(self, assume: Assumptions) -> None:
        self._assume = assume
        self._tilt: tuple[int, float, float] | None = None

    def attitude(
        self, t_ns: int, source: str, roll: float, pitch: float, yaw: float
    ) -> list[TelemetrySample]:
        """All three angles are known."""
        self.tilt(t_ns, roll, pitch)
        return [Attitude(t_ns, t_ns, source, from_euler(roll, pitch, yaw))]

    def tilt(self, t_ns: int, roll: float, pitch: float) -> None:
        """Roll and pitch are known."""
        self._tilt = (t_ns, roll, pitch)

    def heading(self, t_ns: int, source: str, yaw: float) -> list[TelemetrySample]:
        """Only the heading is known, clockwise from true north."""
        tilt = self._tilt
        if tilt is not None and t_ns - tilt[0] <= TILT_LIFE_NS:
            return [Attitude(t_ns, t_ns, source, from_euler(tilt[1], tilt[2], yaw))]
        if self._assume.level:
            return [Attitude(t_ns, t_ns, source, from_euler(0.0, 0.0, yaw))]
        return []

    def turn(self, t_ns: int, source: str, rate_rad_s: float) -> list[TelemetrySample]:
        """Only the rate of turn about the vertical is known, positive to starboard."""
        if not self._assume.level:
            return []
        return [AngularRate(t_ns, t_ns, source, (0.0, 0.0, rate_rad_s))]

    def speed(
        self, t_ns: int, source: str, forward_m_s: float, right_m_s: float | None
    ) -> list[TelemetrySample]:
        """Speed over ground is known ahead, and perhaps sideways."""
        if not self._assume.level or (right_m_s is None and not self._assume.no_side_slip):
            return []
        velocity = (forward_m_s, right_m_s or 0.0, 0.0)
        return [Velocity(t_ns, t_ns, source, velocity, self._assume.speed_sigma_m_s)]
