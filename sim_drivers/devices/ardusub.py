"""An ArduSub autopilot, as MAVLink has it."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.messages import (
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
from aquaflow.sim_drivers.devices.visual_odometry import VisualOdometry

GRAVITY_M_S2 = 9.80665
"""Standard gravity: MAVLink sends accelerations in milli-g."""
SALT_WATER_KG_M3 = 1029.0
"""As the default of the MAVLink driver."""
SURFACE_HPA = 1013.25
"""Standard air; the MAVLink driver's default too."""
BEAT_NS = 1_000_000_000
"""Heartbeats come at 1 Hz."""


class ArduSub:
    """System 1, component 1.

    Attitude is sent as ATTITUDE with the last angular rate, angular rate by RAW_IMU with the last
    specific force, depth by the external SCALED_PRESSURE2 and VFR_HUD, velocity by
    LOCAL_POSITION_NED, altitude by a DISTANCE_SENSOR that looks down, lights by servo 9, UTC by
    SYSTEM_TIME, position by GPS_RAW_INT with an HDOP of 1.6 and, in MAVLink 2, its accuracy.
    """

    def __init__(self, mavlink_2: bool = True) -> None:
        self._dialect: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
        self._wire: Any = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._wire.robust_parsing = True
        self._mavlink_1 = not mavlink_2
        self._rate = (0.0, 0.0, 0.0)
        self._force = (0.0, 0.0, -GRAVITY_M_S2)
        self._R_nb = Rotation.identity()
        self._depth_m = 0.0
        self._beat_ns: int | None = None
        self.answers = 0
        """TIMESYNC requests of ours that were answered."""
        self.heartbeats = 0
        """Heartbeats heard."""
        self.vision = VisualOdometry()
        """The poses that it was sent."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        boot_ms = measured_ns // 1_000_000
        packets: list[bytes] = []
        match sample:
            case Acceleration():
                self._force = sample.acceleration_m_s2
            case AngularRate():
                self._rate = sample.rate_rad_s
                packets = [self._imu(measured_ns // 1000)]
            case Attitude():
                self._R_nb = Rotation.from_quat(np.roll(sample.wxyz, -1))
                yaw, pitch, roll = self._R_nb.as_euler("ZYX")
                packets = [self._packed("attitude", boot_ms, roll, pitch, yaw, *self._rate)]
            case Depth():
                packets = self._pressure(sample.depth_m, boot_ms)
            case Velocity():
                vx, vy, vz = self._R_nb.apply(sample.velocity_m_s)
                local = (0.0, 0.0, self._depth_m, vx, vy, vz)
                packets = [self._packed("local_position_ned", boot_ms, *local)]
            case Altitude():
                packets = [self._range(sample.altitude_m, boot_ms)]
            case Lights():
                packets = [self._servos(1100 + round(800 * sample.level), measured_ns // 1000)]
            case Position():
                packets = [self._fix(sample, measured_ns // 1000)]
            case UtcTime():
                packets = [self._packed("system_time", sample.utc_ns // 1000, boot_ms)]
        return packets

    def answer(self, packet: bytes, now_ns: int) -> list[bytes]:
        answers = []
        for message in self._wire.parse_buffer(packet) or []:
            kind = message.get_type()
            self.vision.take(message, now_ns)
            self.heartbeats += kind == "HEARTBEAT"
            if kind == "TIMESYNC" and message.tc1 == 0:
                answers.append(self._packed("timesync", now_ns, message.ts1))
            elif kind == "TIMESYNC":
                self.answers += 1
        return answers

    def unprompted(self, now_ns: int) -> list[bytes]:
        if self._beat_ns is not None and now_ns < self._beat_ns:
            return []
        self._beat_ns = now_ns + BEAT_NS
        dialect = self._dialect
        submarine, autopilot = dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
        return [
            self._packed("heartbeat", submarine, autopilot, 81, 19, dialect.MAV_STATE_ACTIVE, 3),
            self._packed("system_time", 0, now_ns // 1_000_000),
            self._packed("timesync", 0, now_ns),
        ]

    def _packed(self, message: str, *fields: float) -> bytes:
        built = getattr(self._dialect, f"MAVLink_{message}_message")(*fields)
        data = bytes(built.pack(self._wire, force_mavlink1=self._mavlink_1))
        self._wire.seq = (self._wire.seq + 1) % 256
        return data

    def _imu(self, time_us: int) -> bytes:
        milli_g = [_int16(value / GRAVITY_M_S2 * 1000) for value in self._force]
        milli_rad = [_int16(value * 1000) for value in self._rate]
        return self._packed("raw_imu", time_us, *milli_g, *milli_rad, 0, 0, 0)

    def _pressure(self, depth_m: float, boot_ms: int) -> list[bytes]:
        self._depth_m = depth_m
        hull = self._packed("scaled_pressure", boot_ms, 1009.5, 0.0, 3243)
        water_hpa = SURFACE_HPA + depth_m * SALT_WATER_KG_M3 * GRAVITY_M_S2 / 100
        water = self._packed("scaled_pressure2", boot_ms, water_hpa, 0.0, 1256)
        return [hull, water, self._packed("vfr_hud", 0.0, 0.0, 0, 0, -depth_m, 0.0)]

    def _range(self, altitude_m: float, boot_ms: int) -> bytes:
        down = self._dialect.MAV_SENSOR_ROTATION_PITCH_270
        return self._packed(
            "distance_sensor", boot_ms, 20, 5000, round(altitude_m * 100), 1, 0, down, 255
        )

    def _fix(self, sample: Position, time_us: int) -> bytes:
        place = round(sample.latitude_deg * 1e7), round(sample.longitude_deg * 1e7)
        eph, unknown, satellites = 160, 0xFFFF, 21
        accuracy_mm = 0 if self._mavlink_1 else round(1000 * sample.sigma_m)
        return self._packed(
            "gps_raw_int", time_us, 3, *place, 0, eph, unknown, 0, 0, satellites, 0, accuracy_mm
        )

    def _servos(self, pulse_us: int, time_us: int) -> bytes:
        thrusters = [1500] * 8
        return self._packed("servo_output_raw", time_us % 2**32, 0, *thrusters, pulse_us, *[0] * 7)


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value))) if math.isfinite(value) else 0
