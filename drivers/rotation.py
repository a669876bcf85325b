"""Rotations of single samples; quaternions wxyz, plain floats, since one sample is no array."""

from __future__ import annotations

import math
from typing import TypeAlias

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
