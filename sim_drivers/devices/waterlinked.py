"""A Water Linked DVL, as github.com/waterlinked/docs describes it: serial lines, or JSON on TCP."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.sim_drivers.devices.device import OneWayDevice
from aquaflow.types import Altitude, Attitude, TelemetrySample, Velocity

NO_BOTTOM_M = -1.0
"""What a DVL sends as altitude while it has none."""


def line(body: str) -> bytes:
    """The line with its CRC-8: polynomial 0x07, start 0."""
    crc = 0
    for byte in body.encode():
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
    return f"{body}*{crc:02x}\r\n".encode()


class WaterLinkedSerial(OneWayDevice[bytes]):
    """Velocity as wrz with the last altitude, attitude as wrp."""

    def __init__(self) -> None:
        self._altitude_m = NO_BOTTOM_M

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        match sample:
            case Altitude():
                self._altitude_m = sample.altitude_m
            case Velocity():
                vx, vy, vz = sample.velocity_m_s
                merit = sample.figure_of_merit_m_s
                variance = ";".join(f"{value:g}" for value in (merit**2 * np.eye(3)).ravel())
                return [
                    line(
                        f"wrz,{vx:.4f},{vy:.4f},{vz:.4f},y,{self._altitude_m:.3f},{merit:.4f},"
                        f"{variance},{measured_ns // 1000},{now_ns // 1000},120.5,0"
                    )
                ]
            case Attitude():
                roll, pitch, yaw = euler_deg(sample)
                body = f"wrp,{now_ns / 1e9:.3f},0.0,0.0,0.0,0.5,{roll:.4f},{pitch:.4f},{yaw:.4f},0"
                return [line(body)]
        return []


class WaterLinkedJson(OneWayDevice[bytes]):
    """Velocity with the last altitude, attitude as position_local."""

    def __init__(self) -> None:
        self._altitude_m = NO_BOTTOM_M

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        match sample:
            case Altitude():
                self._altitude_m = sample.altitude_m
            case Velocity():
                return [self._velocity(sample, measured_ns // 1000, now_ns // 1000)]
            case Attitude():
                roll, pitch, yaw = euler_deg(sample)
                report = {
                    "ts": now_ns / 1e9, "x": 0.0, "y": 0.0, "z": 0.0, "std": 0.5, "roll": roll,
                    "pitch": pitch, "yaw": yaw, "type": "position_local", "status": 0,
                    "format": "json_v3.1",
                }  # fmt: skip
                return [_object(report)]
        return []

    def _velocity(self, sample: Velocity, validity_us: int, sent_us: int) -> bytes:
        vx, vy, vz = sample.velocity_m_s
        merit = sample.figure_of_merit_m_s
        beams = [
            {"id": k, "velocity": 0.0, "distance": self._altitude_m, "rssi": -30.7, "nsd": -90.0,
             "beam_valid": True}
            for k in range(4)
        ]  # fmt: skip
        return _object(
            {
                "time": 120.5, "vx": vx, "vy": vy, "vz": vz, "fom": merit,
                "covariance": (merit**2 * np.eye(3)).tolist(), "altitude": self._altitude_m,
                "transducers": beams, "velocity_valid": True, "status": 0, "format": "json_v3.1",
                "type": "velocity", "time_of_validity": validity_us,
                "time_of_transmission": sent_us,
            }
        )  # fmt: skip


def euler_deg(sample: Attitude) -> tuple[float, float, float]:
    """Roll, pitch, yaw."""
    yaw, pitch, roll = Rotation.from_quat(np.roll(sample.wxyz, -1)).as_euler("ZYX", degrees=True)
    return float(roll), float(pitch), float(yaw)


def _object(report: dict[str, object]) -> bytes:
    return json.dumps(report).encode() + b"\r\n"
