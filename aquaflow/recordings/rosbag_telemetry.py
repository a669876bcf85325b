"""Telemetry of a ROS bag: standard messages, from ROS's axes (REP 103) to ours.

ROS has forward-left-up bodies in an east-north-up world; we forward-right-down in north-east-down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from aquaflow.drivers.samples import Vector, normalise, plausible, product, sigma_of
from aquaflow.recordings.rosbag import decode, is_bag, messages_in, open_bag, origin_of, stamp_of
from aquaflow.recordings.telemetry_log import LoggedUtc
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

Convert: TypeAlias = Callable[[Any, int, int, str], list[TelemetrySample]]

NED_FROM_ENU = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
"""Quaternion wxyz: half a turn about the horizontal axis between north and east."""
FLU_FROM_FRD = (0.0, 1.0, 0.0, 0.0)
"""Quaternion wxyz: half a turn about the forward axis."""

SURFACE_PA, WATER_KG_M3, GRAVITY_M_S2 = 101_325.0, 1029.0, 9.80665
"""As the defaults of the MAVLink driver: standard air, salt water."""

NOT_MEASURED = -1.0
"""First element of the covariance of a quantity that is not measured (sensor_msgs/Imu)."""
NO_FIX, UNKNOWN = -1, 0
"""NavSatFix: the status of a receiver without a fix, and the type of a covariance that says
nothing."""


class RosbagTelemetry:
    """Imu, FluidPressure, Range, TwistWithCovarianceStamped and NavSatFix, on the clock of the
    pictures; UTC from the times of reception."""

    specificity = 2

    def __init__(self, path: Path, starts_s: float = 0.0) -> None:
        """Open nothing yet."""
        self.path = path
        self.notes: list[str] = []
        self._shift_ns = round(starts_s * 1e9)
        self._topic: str | None = None

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return is_bag(path)

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> RosbagTelemetry:
        return cls(path, starts_s)

    def follow(self, fps: float | None, topic: str | None) -> None:
        """Times count from the first picture of ``topic``."""
        self._topic = topic

    def samples(self) -> Iterator[TelemetrySample]:
        """Samples in the order of reception; messages of impossible values cost themselves.

        Raises:
            InputError: the bag is damaged.
        """
        bad = 0
        self.notes = []
        with open_bag(self.path) as reader:
            base_ns = origin_of(reader, self._topic) - self._shift_ns
            utc = LoggedUtc(f"{self.path.stem}/bag", iter([(0, base_ns)]))
            wanted = [c for c in reader.connections if c.msgtype in CONVERSIONS]
            for connection, received_ns, data in messages_in(reader, wanted, self.notes):
                message = decode(reader, connection, data)
                arrival_ns = received_ns - base_ns
                yield from utc.at(arrival_ns, received_ns)
                t_ns = min(stamp_of(message, received_ns) - base_ns, arrival_ns)
                source = connection.topic.strip("/")
                try:
                    found = CONVERSIONS[connection.msgtype](message, t_ns, arrival_ns, source)
                except (ValueError, ZeroDivisionError, AttributeError):
                    bad += 1
                    continue
                yield from found
        if bad:
            self.notes.append(f"{bad} messages of {self.path.name} make no sense")

    def close(self) -> None:
        """Nothing stays open between passes."""


def _imu(message: Any, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    found: list[TelemetrySample] = []
    if message.orientation_covariance[0] != NOT_MEASURED:
        q = message.orientation
        enu_flu = normalise(_finite4(q.w, q.x, q.y, q.z))
        wxyz = product(product(NED_FROM_ENU, enu_flu), FLU_FROM_FRD)
        found.append(Attitude(t_ns, arrival_ns, source, wxyz))
    if message.angular_velocity_covariance[0] != NOT_MEASURED:
        found.append(AngularRate(t_ns, arrival_ns, source, _body(message.angular_velocity)))
    if message.linear_acceleration_covariance[0] != NOT_MEASURED:
        found.append(Acceleration(t_ns, arrival_ns, source, _body(message.linear_acceleration)))
    return found


def _pressure(message: Any, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    depth_m = (message.fluid_pressure - SURFACE_PA) / (WATER_KG_M3 * GRAVITY_M_S2)
    return [Depth(t_ns, arrival_ns, source, _finite(depth_m))]


def _range(message: Any, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    if not message.min_range <= message.range <= message.max_range:
        return []
    return [Altitude(t_ns, arrival_ns, source, _finite(message.range))]


def _twist(message: Any, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    """As DVL drivers publish it: velocity over ground in the sensor's frame."""
    sigma = math.sqrt(max(_finite(message.twist.covariance[k]) for k in (0, 7, 14)))
    velocity = _body(message.twist.twist.linear)
    return [Velocity(t_ns, arrival_ns, source, velocity, sigma)]


def _fix(message: Any, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    if message.status.status <= NO_FIX:
        return []
    sigma_m = sigma_of(None)
    if message.position_covariance_type != UNKNOWN:
        sigma_m = math.sqrt((message.position_covariance[0] + message.position_covariance[4]) / 2.0)
    fix = Position(t_ns, arrival_ns, source, message.latitude, message.longitude, sigma_m)
    if not plausible(fix):
        raise ValueError("no place on the earth")
    return [fix]


def _body(vector: Any) -> Vector:
    """Forward-left-up to forward-right-down."""
    return _finite(vector.x), -_finite(vector.y), -_finite(vector.z)


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("not finite")
    return number


def _finite4(w: Any, x: Any, y: Any, z: Any) -> tuple[float, float, float, float]:
    return _finite(w), _finite(x), _finite(y), _finite(z)


CONVERSIONS: dict[str, Convert] = {
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/FluidPressure": _pressure,
    "sensor_msgs/msg/Range": _range,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist,
    "sensor_msgs/msg/NavSatFix": _fix,
}
"""Messages that are read."""
