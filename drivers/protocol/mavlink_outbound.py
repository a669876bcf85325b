"""AquaFlow's messages to an autopilot in MAVLink (mavlink.io/en/messages/common.html)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.sources.outbound import (
    LONGEST_NAME,
    LONGEST_TEXT,
    BodyPose,
    BodyPoseChange,
    NamedValue,
    OutboundMessage,
    StatusText,
)

Array: TypeAlias = npt.NDArray[np.float64]

LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12
"""MAV_FRAME: of a world whose x points north, of one with any heading, and of the body."""
ARDUPILOT = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA. Its GCS_MAVLINK::handle_odometry reads LOCAL_FRD with BODY_FRD as
north-east-down, and drops every other frame without a word."""
ESTIMATOR_VISION = 2
"""MAV_ESTIMATOR_TYPE_VISION: a camera, without inertial sensors."""
ROWS, COLUMNS = np.triu_indices(6)
"""The upper triangle row by row: 21 numbers of a 6 x 6 covariance."""
MOST_NUMBERS = 65_535
"""Numbers of texts, which are 1 to that many."""
LARGEST = 1e6
"""Metres; beyond is no position."""


@dataclass(frozen=True)
class Receiver:
    """What is known of the autopilot that a message goes to."""

    boot_ns: int | None = None
    """The message's moment on its clock; None while that clock is unknown."""
    autopilot: int | None = None
    """MAV_AUTOPILOT of its heartbeats; None before the first."""


def messages_of(
    dialect: Any, outbound: OutboundMessage, receiver: Receiver, number: int
) -> list[Any]:
    """The MAVLink messages of ``outbound``, of which ``number`` is told from the ones before; of a
    text that is long several, else one, or none."""
    if isinstance(outbound, StatusText):
        return text_messages(dialect, outbound, number % MOST_NUMBERS + 1)
    message = _message_of(dialect, outbound, receiver)
    return [] if message is None else [message]


def _message_of(
    dialect: Any, outbound: NamedValue | BodyPose | BodyPoseChange, receiver: Receiver
) -> Any | None:
    """The message of a value, a pose or a motion.

    None for a pose or a motion that is not finite, or while the receiver's clock is unknown: its
    filter must not take a pose for one of another moment.
    """
    boot_ns = receiver.boot_ns
    if isinstance(outbound, NamedValue):
        name = outbound.name.encode("ascii", "replace")[:LONGEST_NAME]
        boot_ms = ((outbound.t_ns if boot_ns is None else boot_ns) // 1_000_000) % 2**32
        return dialect.MAVLink_named_value_float_message(boot_ms, name, outbound.value)
    if boot_ns is None:
        return None
    if isinstance(outbound, BodyPoseChange):
        return _delta(dialect, outbound, boot_ns)
    return _odometry(dialect, outbound, boot_ns, receiver.autopilot)


def _delta(dialect: Any, motion: BodyPoseChange, boot_ns: int) -> Any | None:
    if not (np.isfinite(motion.rotation).all() and np.isfinite(motion.translation_m).all()):
        return None
    return dialect.MAVLink_vision_position_delta_message(
        time_usec=boot_ns // 1000,
        time_delta_usec=motion.since_ns // 1000,
        angle_delta=_floats(motion.rotation),
        position_delta=_floats(motion.translation_m),
        confidence=100.0 * min(max(motion.quality, 0.0), 1.0),
    )


def _odometry(dialect: Any, pose: BodyPose, boot_ns: int, autopilot: int | None) -> Any | None:
    numbers = (
        pose.R, pose.covariance, pose.velocity_m_s, pose.rate_rad_s, pose.motion_covariance
    )  # fmt: skip
    finite = all(bool(np.isfinite(each).all()) for each in numbers)
    if not finite or not bool(np.all(np.abs(pose.t_m) < LARGEST)):
        return None
    x, y, z = _floats(pose.t_m)
    vx, vy, vz = _floats(pose.velocity_m_s)
    rollspeed, pitchspeed, yawspeed = _floats(pose.rate_rad_s)
    return dialect.MAVLink_odometry_message(
        time_usec=boot_ns // 1000,
        frame_id=_local_frame(pose, autopilot),
        child_frame_id=BODY_FRD,
        x=x, y=y, z=z,
        q=_floats(Rotation.from_matrix(pose.R).as_quat(canonical=True, scalar_first=True)),
        vx=vx, vy=vy, vz=vz,
        rollspeed=rollspeed, pitchspeed=pitchspeed, yawspeed=yawspeed,
        pose_covariance=_floats(pose.covariance[ROWS, COLUMNS]),
        velocity_covariance=_floats(pose.motion_covariance[ROWS, COLUMNS]),
        reset_counter=pose.reset_counter % 256,
        estimator_type=ESTIMATOR_VISION,
        # 0 would say that the quality is unknown.
        quality=max(1, round(100.0 * min(pose.quality, 1.0))),
    )  # fmt: skip


def _local_frame(pose: BodyPose, autopilot: int | None) -> int:
    """LOCAL_FRD, which every autopilot reads; LOCAL_NED to others than ArduPilot, if x is north."""
    known_other = autopilot is not None and autopilot != ARDUPILOT
    return LOCAL_NED if pose.north and known_other else LOCAL_FRD


def _floats(
    values: Array,  # [N]
) -> list[float]:
    return [float(value) for value in values]


# --------------------------------------------------------------------------------------------------
# STATUSTEXT, whole or in MAVLink 2's chunks (mavlink.io/en/messages/common.html#STATUSTEXT).

SEVERITIES = {"error": 3, "warning": 4, "notice": 5, "info": 6}
"""MAV_SEVERITY."""
MOST_CHUNKS = 5
"""Of one text; what is longer than 249 characters is cut: nobody reads that while steering."""
ALONE = 0
"""``id`` of a text that is whole."""


def text_messages(dialect: Any, outbound: StatusText, number: int) -> list[Any]:
    """One message, or the chunks of a longer text, which ``number`` (1 to 65535) holds together.

    A null character ends a text: one that fills its last chunk is followed by an empty one.
    """
    text = outbound.text.encode("ascii", "replace")
    if len(text) <= LONGEST_TEXT:
        return [_chunk(dialect, outbound, text, ALONE, 0)]
    text = text[: MOST_CHUNKS * LONGEST_TEXT - 1]
    return [
        _chunk(dialect, outbound, text[at : at + LONGEST_TEXT], number, sequence)
        for sequence, at in enumerate(range(0, len(text) + 1, LONGEST_TEXT))
    ]


def _chunk(dialect: Any, outbound: StatusText, text: bytes, number: int, sequence: int) -> Any:
    return dialect.MAVLink_statustext_message(
        severity=SEVERITIES[outbound.severity], text=text, id=number, chunk_seq=sequence
    )
