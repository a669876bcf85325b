"""An ArduSub autopilot, as MAVLink has it."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.sim_drivers.devices.visual_odometry import VisualOdometry
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

    def __init__(self, mavlink_2: bool = True, sonar_component: int = 1) -> None:
        """``sonar_component``: who sends DISTANCE_SENSOR; 194 is BlueOS's Ping service."""
        self._dialect: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
        self._wire: Any = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._wire.robust_parsing = True
        self._sonar: Any = self._dialect.MAVLink(None, srcSystem=1, srcComponent=sonar_component)
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
        self.armed = False
        """As its heartbeats say."""
        self.acknowledged: list[tuple[int, int]] = []
        """Command and result of each COMMAND_ACK heard."""
        self.texts: list[str] = []
        """Of each STATUSTEXT heard."""
        self._commands: list[bytes] = []
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
                packets = [self._pack("attitude", boot_ms, roll, pitch, yaw, *self._rate)]
            case Depth():
                packets = self._pressure(sample.depth_m, boot_ms)
            case Velocity():
                vx, vy, vz = self._R_nb.apply(sample.velocity_m_s)
                local = (0.0, 0.0, self._depth_m, vx, vy, vz)
                packets = [self._pack("local_position_ned", boot_ms, *local)]
            case Altitude():
                packets = [self._range(sample.altitude_m, boot_ms)]
            case Lights():
                packets = [self._servos(1100 + round(800 * sample.level), measured_ns // 1000)]
            case Position():
                packets = [self._fix(sample, measured_ns // 1000)]
            case UtcTime():
                packets = [self._pack("system_time", sample.utc_ns // 1000, boot_ms)]
        return packets

    def answer(self, packet: bytes, now_ns: int) -> list[bytes]:
        answers = []
        for message in self._wire.parse_buffer(packet) or []:
            kind = message.get_type()
            self.vision.take(message, now_ns)
            self.heartbeats += kind == "HEARTBEAT"
            if kind == "COMMAND_ACK":
                self.acknowledged.append((message.command, message.result))
            if kind == "STATUSTEXT":
                self.texts.append(message.text)
            if kind == "TIMESYNC" and message.tc1 == 0:
                answers.append(self._pack("timesync", now_ns, message.ts1))
            elif kind == "TIMESYNC":
                self.answers += 1
        return answers

    def command(self, number: int, component: int, confirmation: int = 0) -> None:
        """Route a COMMAND_LONG of the ground station (system 255, component 190)."""
        station = self._dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        command = self._dialect.MAVLink_command_long_message(
            1, component, number, confirmation, *[0.0] * 7
        )
        self._commands.append(bytes(command.pack(station)))

    def due_packets(self, now_ns: int) -> list[bytes]:
        routed, self._commands = self._commands, []
        if self._beat_ns is not None and now_ns < self._beat_ns:
            return routed
        self._beat_ns = now_ns + BEAT_NS
        dialect = self._dialect
        submarine, autopilot = dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
        mode = 81 | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        return [
            *routed,
            self._pack("heartbeat", submarine, autopilot, mode, 19, dialect.MAV_STATE_ACTIVE, 3),
            self._pack("system_time", 0, now_ns // 1_000_000),
            self._pack("timesync", 0, now_ns),
        ]

    def _pack(self, message: str, *fields: float) -> bytes:
        return self._packed_by(self._wire, message, *fields)

    def _packed_by(self, wire: Any, message: str, *fields: float) -> bytes:
        built = getattr(self._dialect, f"MAVLink_{message}_message")(*fields)
        data = bytes(built.pack(wire, force_mavlink1=self._mavlink_1))
        wire.seq = (wire.seq + 1) % 256
        return data

    def _imu(self, time_us: int) -> bytes:
        milli_g = [_int16(value / GRAVITY_M_S2 * 1000) for value in self._force]
        milli_rad = [_int16(value * 1000) for value in self._rate]
        return self._pack("raw_imu", time_us, *milli_g, *milli_rad, 0, 0, 0)

    def _pressure(self, depth_m: float, boot_ms: int) -> list[bytes]:
        self._depth_m = depth_m
        hull = self._pack("scaled_pressure", boot_ms, 1009.5, 0.0, 3243)
        water_hpa = SURFACE_HPA + depth_m * SALT_WATER_KG_M3 * GRAVITY_M_S2 / 100
        water = self._pack("scaled_pressure2", boot_ms, water_hpa, 0.0, 1256)
        return [hull, water, self._pack("vfr_hud", 0.0, 0.0, 0, 0, -depth_m, 0.0)]

    def _range(self, altitude_m: float, boot_ms: int) -> bytes:
        down = self._dialect.MAV_SENSOR_ROTATION_PITCH_270
        centimetres = round(altitude_m * 100)
        return self._packed_by(
            self._sonar, "distance_sensor", boot_ms, 20, 5000, centimetres, 1, 0, down, 255
        )

    def _fix(self, sample: Position, time_us: int) -> bytes:
        place = round(sample.latitude_deg * 1e7), round(sample.longitude_deg * 1e7)
        eph, unknown, satellites = 160, 0xFFFF, 21
        accuracy_mm = 0 if self._mavlink_1 else round(1000 * sample.sigma_m)
        return self._pack(
            "gps_raw_int", time_us, 3, *place, 0, eph, unknown, 0, 0, satellites, 0, accuracy_mm
        )

    def _servos(self, pulse_us: int, time_us: int) -> bytes:
        thrusters = [1500] * 8
        return self._pack("servo_output_raw", time_us % 2**32, 0, *thrusters, pulse_us, *[0] * 7)


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value))) if math.isfinite(value) else 0
