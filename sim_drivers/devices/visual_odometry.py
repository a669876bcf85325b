"""What an ArduPilot autopilot takes of the poses that it is sent, and what is wrong with them.

As GCS_MAVLINK::handle_odometry and AP_VisualOdom (ArduPilot 4.7) read them: the pose is taken for
north-east-down whatever the frame's name says, the quaternion turns the body into it and the
velocity likewise. A message in another frame than LOCAL_FRD with BODY_FRD is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

LOCAL_FRD, BODY_FRD = 20, 12
"""The MAV_FRAMEs that it reads."""
LEAST_HZ = 4.0
"""Below that its filter leaves external poses unused (mavlink-nongps-position-estimation)."""
FLOAT32 = 1e-5
"""Rounding of what the message holds, relative."""


@dataclass(frozen=True)
class HeardPose:
    """An ODOMETRY as its filter takes it."""

    t_ns: int
    """On the autopilot's clock."""
    R: Array
    """[3, 3] body to NED."""
    position_m: Array
    """[3] NED."""
    velocity_m_s: Array
    """[3] NED."""
    rate_rad_s: Array
    """[3] body."""
    covariance: Array
    """[6, 6] of x, y, z, roll, pitch, yaw."""
    velocity_covariance: Array
    """[6, 6] of velocity and rate in the body."""
    reset_counter: int


@dataclass(frozen=True)
class HeardDelta:
    """A VISION_POSITION_DELTA."""

    since_ns: int
    angle_rad: Array
    """[3]"""
    position_m: Array
    """[3] body."""
    confidence: float


class VisualOdometry:
    """Poses and motions as they were read, and complaints about those that a filter cannot use."""

    def __init__(self) -> None:
        self.poses: list[HeardPose] = []
        self.deltas: list[HeardDelta] = []
        self.dropped = 0
        """Poses in a frame that it does not read."""
        self.complaints: list[str] = []

    def take(self, message: Any, now_ns: int) -> None:
        """A decoded ODOMETRY or VISION_POSITION_DELTA that arrived at ``now_ns``."""
        kind = message.get_type()
        if kind in ("ODOMETRY", "VISION_POSITION_DELTA"):
            self._check(message.time_usec * 1000 <= now_ns, "it is of the future")
        if kind == "ODOMETRY":
            self._odometry(message)
        elif kind == "VISION_POSITION_DELTA":
            self._delta(message)

    def rate_hz(self) -> float:
        """Poses a second, by their stamps."""
        span_s = 1e-9 * (self.poses[-1].t_ns - self.poses[0].t_ns)
        return (len(self.poses) - 1) / span_s

    def _odometry(self, message: Any) -> None:
        if (message.frame_id, message.child_frame_id) != (LOCAL_FRD, BODY_FRD):
            self.dropped += 1
            return
        q = np.array(message.q, np.float64)
        self._check(abs(float(np.linalg.norm(q)) - 1.0) < FLOAT32, "the quaternion is no unit")
        self._check(1 <= message.quality <= 100, "the quality is not stated")
        R = np.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())
        velocity = np.array([message.vx, message.vy, message.vz])
        rate = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        # AP_VisualOdom hands a velocity on without looking whether it is a number.
        self._check(bool(np.isfinite([*velocity, *rate]).all()), "the velocity is no number")
        heard = HeardPose(
            message.time_usec * 1000, R, np.array([message.x, message.y, message.z]),
            R @ velocity, rate,
            self._covariance(message.pose_covariance),
            self._covariance(message.velocity_covariance),
            message.reset_counter,
        )  # fmt: skip
        if self.poses:
            self._check(heard.t_ns > self.poses[-1].t_ns, "it is older than the one before")
        self.poses.append(heard)

    def _delta(self, message: Any) -> None:
        self._check(message.time_delta_usec > 0, "the motion takes no time")
        self._check(0.0 <= message.confidence <= 100.0, "the confidence is no percentage")
        self._check(message.time_delta_usec <= 1e6 / LEAST_HZ, "motions come too rarely")
        angle, moved = np.array(message.angle_delta), np.array(message.position_delta)
        self._check(bool(np.isfinite([*angle, *moved]).all()), "the motion is no number")
        since_ns = message.time_delta_usec * 1000
        self.deltas.append(HeardDelta(since_ns, angle, moved, message.confidence))

    def _covariance(
        self,
        upper: Any,  # [21] the upper right triangle, row by row
    ) -> Array:
        covariance = np.zeros((6, 6))
        covariance[np.triu_indices(6)] = upper
        covariance += np.triu(covariance, 1).T
        finite = bool(np.isfinite(covariance).all())
        self._check(finite, "a covariance is no number")
        if finite:
            least, most = np.linalg.eigvalsh(covariance)[[0, -1]]
            self._check(bool(least > -FLOAT32 * most), "a covariance is not positive")
        return covariance

    def _check(self, good: bool, complaint: str) -> None:
        if not good:
            self.complaints.append(complaint)
