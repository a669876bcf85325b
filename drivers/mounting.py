"""From a sensor's frame and position to the vehicle's body: rotation and lever arm."""

from __future__ import annotations

import math
from dataclasses import replace

from aquaflow.config.stage import MountingConfig
from aquaflow.drivers.samples import Vector, cross, from_euler, inverse, move, product, rotate
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    Velocity,
)

STATE_LIFE_NS = 500_000_000
"""An attitude or a rate older than this is not used: an ROV turns at up to 90 deg/s."""


class Mounting:
    """Where one sensor sits: ``q_bs`` turns its axes into the body's, ``arm_b`` is its place."""

    def __init__(self, config: MountingConfig) -> None:
        angles = (config.roll_deg, config.pitch_deg, config.yaw_deg)
        self.q_bs = from_euler(*map(math.radians, angles))
        self.arm_b: Vector = config.position_m
        self.turned = any(angles)


class BodyFrame:
    """Refers every sample to the body's origin and axes, in the order of arrival.

    A sensor off the origin feels the body turn: a DVL measures v + omega x arm, a pressure sensor
    sits deeper or shallower as the body leans. The last attitude and rate of any device are
    used; without them the body counts as level and not turning, and a fix is as much less certain
    as the arm is long. Specific force is turned, but its lever arm is left in, since no device
    measures angular acceleration.
    """

    def __init__(self) -> None:
        self._attitude: Attitude | None = None
        self._rate: AngularRate | None = None

    def refer(self, sample: TelemetrySample, mounting: Mounting) -> TelemetrySample:
        """``sample`` as a sensor at the body's origin would have it."""
        if mounting.turned:
            sample = _turn(sample, mounting)
        if isinstance(sample, Attitude):
            self._attitude = sample
        elif isinstance(sample, AngularRate):
            self._rate = sample
        return self._move(sample, mounting.arm_b) if any(mounting.arm_b) else sample

    def _move(self, sample: TelemetrySample, arm_b: Vector) -> TelemetrySample:
        if isinstance(sample, Velocity):
            if self._rate is None or _stale(self._rate, sample):
                return sample
            swing = cross(self._rate.rate_rad_s, arm_b)
            v = sample.velocity_m_s
            return replace(sample, velocity_m_s=(v[0] - swing[0], v[1] - swing[1], v[2] - swing[2]))
        if isinstance(sample, Depth):
            return replace(sample, depth_m=sample.depth_m - self._below(arm_b, sample))
        if isinstance(sample, Altitude):
            return replace(sample, altitude_m=sample.altitude_m + self._below(arm_b, sample))
        if isinstance(sample, Position):
            return self._origin(sample, arm_b)
        return sample

    def _origin(self, antenna: Position, arm_b: Vector) -> Position:
        if self._attitude is None or _stale(self._attitude, antenna):
            arm_m = math.hypot(arm_b[0], arm_b[1]) / math.sqrt(2.0)
            return replace(antenna, sigma_m=math.hypot(antenna.sigma_m, arm_m))
        north_m, east_m, _ = rotate(self._attitude.wxyz, arm_b)
        return move(antenna, -north_m, -east_m)

    def _below(self, arm_b: Vector, sample: TelemetrySample) -> float:
        """How far the sensor lies below the body's origin, metres."""
        if self._attitude is None or _stale(self._attitude, sample):
            return arm_b[2]
        return rotate(self._attitude.wxyz, arm_b)[2]


def _stale(state: Attitude | AngularRate, sample: TelemetrySample) -> bool:
    return abs(sample.t_ns - state.t_ns) > STATE_LIFE_NS


def _turn(sample: TelemetrySample, mounting: Mounting) -> TelemetrySample:
    q = mounting.q_bs
    if isinstance(sample, Attitude):
        return replace(sample, wxyz=product(sample.wxyz, inverse(q)))
    if isinstance(sample, AngularRate):
        return replace(sample, rate_rad_s=rotate(q, sample.rate_rad_s))
    if isinstance(sample, Acceleration):
        return replace(sample, acceleration_m_s2=rotate(q, sample.acceleration_m_s2))
    if isinstance(sample, Velocity):
        return replace(sample, velocity_m_s=rotate(q, sample.velocity_m_s))
    return sample
