"""AquaFlow's messages to an autopilot in MAVLink (mavlink.io/en/messages/common.html)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.sources.outbound import (
    LONGEST_NAME,
    LONGEST_TEXT,
    BodyMotion,
    BodyPose,
    NamedValue,
    OutboundMessage,
    StatusText,
)

SEVERITIES = {"error": 3, "warning": 4, "notice": 5, "info": 6}
"""MAV_SEVERITY."""
LOCAL_FRD, BODY_FRD = 20, 12
"""MAV_FRAME of the world and of the body."""
ESTIMATOR_VISION = 2
"""MAV_ESTIMATOR_TYPE_VISION: a camera, without inertial sensors."""
UNKNOWN = float("nan")
"""As ODOMETRY wants it in velocities, and in the first number of a covariance, that are not
known."""
ROWS, COLUMNS = np.triu_indices(6)
"""The upper triangle row by row: 21 numbers of a 6 x 6 covariance."""
LARGEST = 1e6
"""Metres; beyond is no position."""


def message_of(dialect: Any, outbound: OutboundMessage, boot_ns: int | None) -> Any | None:
    """The MAVLink message of ``outbound``; None for one that is not finite.

    ``boot_ns``: the word's moment on the autopilot's own clock, if that is known.
    """
    if isinstance(outbound, StatusText):
        text = outbound.text.encode("ascii", "replace")[:LONGEST_TEXT]
        return dialect.MAVLink_statustext_message(severity=SEVERITIES[outbound.severity], text=text)
    t_ns = outbound.t_ns if boot_ns is None else boot_ns
    if isinstance(outbound, NamedValue):
        name = outbound.name.encode("ascii", "replace")[:LONGEST_NAME]
        boot_ms = (t_ns // 1_000_000) % 2**32
        return dialect.MAVLink_named_value_float_message(boot_ms, name, outbound.value)
    if isinstance(outbound, BodyMotion):
        return _delta(dialect, outbound, t_ns)
    return _odometry(dialect, outbound, t_ns)


def _delta(dialect: Any, motion: BodyMotion, t_ns: int) -> Any | None:
    if not (np.isfinite(motion.rotation).all() and np.isfinite(motion.translation_m).all()):
        return None
    return dialect.MAVLink_vision_position_delta_message(
        time_usec=t_ns // 1000,
        time_delta_usec=motion.since_ns // 1000,
        angle_delta=[float(v) for v in motion.rotation],
        position_delta=[float(v) for v in motion.translation_m],
        confidence=100.0 * min(max(motion.quality, 0.0), 1.0),
    )


def _odometry(dialect: Any, pose: BodyPose, t_ns: int) -> Any | None:
    finite = np.isfinite(pose.R).all() and np.isfinite(pose.covariance).all()
    if not finite or not bool(np.all(np.abs(pose.t_m) < LARGEST)):
        return None
    x, y, z = (float(v) for v in pose.t_m)
    q = Rotation.from_matrix(pose.R).as_quat(canonical=True, scalar_first=True)
    return dialect.MAVLink_odometry_message(
        time_usec=t_ns // 1000,
        frame_id=LOCAL_FRD,
        child_frame_id=BODY_FRD,
        x=x, y=y, z=z,
        q=[float(v) for v in q],
        vx=UNKNOWN, vy=UNKNOWN, vz=UNKNOWN,
        rollspeed=UNKNOWN, pitchspeed=UNKNOWN, yawspeed=UNKNOWN,
        pose_covariance=[float(v) for v in pose.covariance[ROWS, COLUMNS]],
        velocity_covariance=[UNKNOWN] + [0.0] * 20,
        reset_counter=pose.reset_counter % 256,
        estimator_type=ESTIMATOR_VISION,
        quality=round(100.0 * min(max(pose.quality, 0.0), 1.0)),
    )  # fmt: skip
