"""Samples of each MAVLink message, in our units (docs/conventions.md).

MAVLink's body frame is forward-right-down and its world NED, so only units change; layouts are in
mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.samples import (
    Fixes,
    Quaternion,
    from_euler,
    inverse,
    normalise,
    rotate,
    sigma_of,
)
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

GRAVITY_M_S2 = 9.80665
"""Standard gravity: the g of MAVLink's milli-g, and what turns pressure into depth."""
MILLI_G = GRAVITY_M_S2 / 1000.0
"""m/s^2; unit of RAW_IMU and SCALED_IMU2."""
HPA = 100.0
"""Pa; unit of the pressure messages."""
DOWN = 25
"""MAV_SENSOR_ROTATION_PITCH_270: a range finder that looks down."""
INVALID_SIGNAL = 1
"""DISTANCE_SENSOR.signal_quality: 0 unknown, 1 invalid, 100 perfect."""
HIGHRES_ACCELERATION, HIGHRES_GYRO = 0x07, 0x38
"""Bits of HIGHRES_IMU.fields_updated."""
ATTITUDE_LIFE_NS = 500_000_000
"""An older attitude does not turn a velocity into body axes; autopilots send several a second."""
FIX_3D = 3
"""GPS_FIX_TYPE_3D_FIX: the least that places a vehicle; those above are better."""
DEGREES = 1e-7
"""Of one count of latitude and longitude."""
UNKNOWN_EPH = 0xFFFF
"""eph is HDOP times 100."""
IGNORE_HDOP, IGNORE_ACCURACY = 2, 64
"""Of GPS_INPUT_IGNORE_FLAGS: HDOP, and horizontal accuracy."""
SINCE_1970_US = 1_000_000_000_000_000
"""A time_usec above is not the time since boot: that would be 31 years."""


class MessageTime(NamedTuple):
    """The first three fields of every sample."""

    t_ns: int
    arrival_ns: int
    source: str


Samples: TypeAlias = list[TelemetrySample]


class MavlinkSamples:
    """Samples of the messages that the config asks one sender for."""

    def __init__(self, config: MavlinkConfig, messages: Iterable[str]) -> None:
        self._config = config
        self._attitude: tuple[int, Quaternion] | None = None
        self._fixes = Fixes(config)
        self._fixed_us: dict[str, int] = {}
        known: dict[str, Callable[[Any, MessageTime], Samples]] = {
            "ATTITUDE": self._euler,
            "ATTITUDE_QUATERNION": self._quaternion,
            "RAW_IMU": _milli_imu,
            "SCALED_IMU2": _milli_imu,
            "HIGHRES_IMU": _highres_imu,
            "LOCAL_POSITION_NED": self._local_position,
            "VFR_HUD": lambda message, stamp: [Depth(*stamp, -message.alt)],
            "DISTANCE_SENSOR": _distance,
            "GPS_RAW_INT": self._fix,
            "GPS2_RAW": self._fix,
            "GLOBAL_POSITION_INT": self._filtered_position,
            "SYSTEM_TIME": _utc,
            "GPS_INPUT": self._fed_fix,
            "VISION_POSITION_DELTA": self._motion,
            "SCALED_PRESSURE": self._pressure,
            "SCALED_PRESSURE2": self._pressure,
            "SCALED_PRESSURE3": self._pressure,
            "SERVO_OUTPUT_RAW": self._lights,
            "RC_CHANNELS": self._lights,
        }
        self._converters = {name: known[name] for name in messages}

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the messages that make samples."""
        return frozenset(self._converters)

    def of(self, message: Any, stamp: MessageTime) -> Samples:
        """Samples of a decoded pymavlink message; ValueError where it says itself it is invalid."""
        return self._converters[message.get_type()](message, stamp)

    def _euler(self, message: Any, stamp: MessageTime) -> Samples:
        return self._orientation(
            from_euler(message.roll, message.pitch, message.yaw), message, stamp
        )

    def _quaternion(self, message: Any, stamp: MessageTime) -> Samples:
        q = normalise((message.q1, message.q2, message.q3, message.q4))
        return self._orientation(q, message, stamp)

    def _orientation(self, q: Quaternion, message: Any, stamp: MessageTime) -> Samples:
        self._attitude = (stamp.t_ns, q)
        rate = (message.rollspeed, message.pitchspeed, message.yawspeed)
        return [Attitude(*stamp, q), AngularRate(*stamp, rate)]

    def _pressure(self, message: Any, stamp: MessageTime) -> Samples:
        over_surface_pa = message.press_abs * HPA - self._config.surface_pressure_pa
        depth_m = over_surface_pa / (self._config.water_density_kg_m3 * GRAVITY_M_S2)
        return [Depth(*stamp, depth_m)]

    def _local_position(self, message: Any, stamp: MessageTime) -> Samples:
        samples: Samples = [Depth(*stamp, message.z)]
        if self._attitude and abs(stamp.t_ns - self._attitude[0]) < ATTITUDE_LIFE_NS:
            v_ned = (message.vx, message.vy, message.vz)
            v_body = rotate(inverse(self._attitude[1]), v_ned)
            samples.append(Velocity(*stamp, v_body, self._config.local_velocity_sigma_m_s))
        return samples

    def _fix(self, message: Any, stamp: MessageTime) -> Samples:
        """A receiver's fix, each once: an autopilot sends the last until the next is there."""
        if message.fix_type < FIX_3D:
            return []  # under water a receiver has none, and that is no fault
        if message.time_usec and message.time_usec == self._fixed_us.get(stamp.source):
            return []
        self._fixed_us[stamp.source] = message.time_usec
        hdop = None if message.eph == UNKNOWN_EPH else message.eph / 100.0
        sigma_m = message.h_acc / 1000.0 or sigma_of(hdop)
        found = self._fixes.fix(*stamp, message.lat * DEGREES, message.lon * DEGREES, sigma_m)
        if message.time_usec > SINCE_1970_US:
            t_ns = self._fixes.date(stamp.t_ns)
            found.append(UtcTime(t_ns, *stamp[1:], 1000 * message.time_usec))
        return found

    def _fed_fix(self, message: Any, stamp: MessageTime) -> Samples:
        """GPS_INPUT: a fix on its way to the autopilot, as acoustic systems send it."""
        if message.fix_type < FIX_3D:
            return []
        stated = message.horiz_accuracy if not message.ignore_flags & IGNORE_ACCURACY else 0.0
        hdop = None if message.ignore_flags & IGNORE_HDOP else message.hdop
        sigma_m = stated or sigma_of(hdop)
        return self._fixes.fix(*stamp, message.lat * DEGREES, message.lon * DEGREES, sigma_m)

    def _motion(self, message: Any, stamp: MessageTime) -> Samples:
        """VISION_POSITION_DELTA: what the body moved and turned by since the message before, in
        its own axes; a DVL's extension of BlueOS sends it to the autopilot."""
        if message.confidence <= 0.0 or message.time_delta_usec == 0:
            raise ValueError("the odometry calls its motion invalid")
        t_ns = stamp.t_ns - 500 * message.time_delta_usec  # the middle of the interval
        dt_s = 1e-6 * message.time_delta_usec
        (vx, vy, vz), (wx, wy, wz) = (
            tuple(each / dt_s for each in delta)
            for delta in (message.position_delta, message.angle_delta)
        )
        sigma_m_s = self._config.local_velocity_sigma_m_s
        return [
            Velocity(t_ns, *stamp[1:], (vx, vy, vz), sigma_m_s),
            AngularRate(t_ns, *stamp[1:], (wx, wy, wz)),
        ]

    def _filtered_position(self, message: Any, stamp: MessageTime) -> Samples:
        """The filter has the receiver's lag taken out, and states no accuracy."""
        sigma_m = self._config.position_sigma_m or sigma_of(None)
        return [Position(*stamp, message.lat * DEGREES, message.lon * DEGREES, sigma_m)]

    def _lights(self, message: Any, stamp: MessageTime) -> Samples:
        lights = self._config.lights
        assert lights is not None
        if lights.message == "RC_CHANNELS":
            pulse_us = getattr(message, f"chan{lights.channel}_raw")
        elif message.port == 0:
            pulse_us = getattr(message, f"servo{lights.channel}_raw")
        else:
            return []  # servos 17 to 32
        if pulse_us in (0, 0xFFFF):
            return []  # the channel is not in use
        level = (pulse_us - lights.off_us) / (lights.full_us - lights.off_us)
        return [Lights(*stamp, min(max(level, 0.0), 1.0))]


def _utc(message: Any, stamp: MessageTime) -> Samples:
    """Zero until the autopilot has heard the time from a receiver or a ground station."""
    if message.time_unix_usec == 0:
        return []
    return [UtcTime(*stamp, 1000 * message.time_unix_usec)]


def _milli_imu(message: Any, stamp: MessageTime) -> Samples:
    acceleration = (message.xacc, message.yacc, message.zacc)
    gyro = (message.xgyro, message.ygyro, message.zgyro)
    samples: Samples = []
    # Permanent free fall means that there is no sensor; SCALED_IMU2 is often only a compass.
    if any(acceleration):
        x, y, z = (value * MILLI_G for value in acceleration)
        samples.append(Acceleration(*stamp, (x, y, z)))
    if any(acceleration) or any(gyro):
        x, y, z = (value * 1e-3 for value in gyro)
        samples.append(AngularRate(*stamp, (x, y, z)))
    return samples


def _highres_imu(message: Any, stamp: MessageTime) -> Samples:
    samples: Samples = []
    if message.fields_updated & HIGHRES_ACCELERATION == HIGHRES_ACCELERATION:
        samples.append(Acceleration(*stamp, (message.xacc, message.yacc, message.zacc)))
    if message.fields_updated & HIGHRES_GYRO == HIGHRES_GYRO:
        samples.append(AngularRate(*stamp, (message.xgyro, message.ygyro, message.zgyro)))
    return samples


def _distance(message: Any, stamp: MessageTime) -> Samples:
    if message.orientation != DOWN:
        return []
    if message.signal_quality == INVALID_SIGNAL:
        raise ValueError("the range finder calls its signal invalid")
    if not message.min_distance <= message.current_distance <= message.max_distance:
        raise ValueError("the range finder sees no bottom within its range")
    return [Altitude(*stamp, message.current_distance / 100.0)]
