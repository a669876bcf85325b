"""A dive in ROS: topics, frames and message definitions, the same in a file and live."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.dive.placement import Placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

TF, TF_STATIC = "/tf", "/tf_static"
POSE, PATH, POINTS = "/aquaflow/pose", "/aquaflow/path", "/aquaflow/points"
CAMERA_INFO, CAMERA = "/camera/camera_info", "/camera/image/compressed"
RENDERED, RESTORED = "/camera/rendered/compressed", "/camera/restored/compressed"
DIAGNOSTICS = "/diagnostics"
DEPTH, ALTITUDE = "/aquaflow/depth_m", "/aquaflow/altitude_m"
HEADING, SPEED = "/aquaflow/heading_deg", "/aquaflow/speed_m_s"
QUALITY, FIX = "/aquaflow/inlier_share", "/aquaflow/fix"

TYPES = {
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PATH: "nav_msgs/msg/Path",
    POINTS: "sensor_msgs/msg/PointCloud2",
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    CAMERA: "sensor_msgs/msg/CompressedImage",
    RENDERED: "sensor_msgs/msg/CompressedImage",
    RESTORED: "sensor_msgs/msg/CompressedImage",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    DEPTH: "std_msgs/msg/Float64",
    ALTITUDE: "std_msgs/msg/Float64",
    HEADING: "std_msgs/msg/Float64",
    SPEED: "std_msgs/msg/Float64",
    QUALITY: "std_msgs/msg/Float64",
    FIX: "sensor_msgs/msg/NavSatFix",
}
"""The message type of each."""

LASTING = frozenset({TF_STATIC, PATH, POINTS})
"""Whose newest message stays true: who comes later gets it too (transient local)."""

OF_FINISHED_DIVES = frozenset({SPEED, FIX})
"""What a live connection does not have: trajectory.csv has it."""


# --------------------------------------------------------------------------------------------------
# ROS 2's message definitions and their CDR encoding, by rosbags: no ROS is needed.
#
# The messages used here have been the same in every ROS 2 release since Humble; a test compares
# them with the type hashes (REP-2016) that ROS 2 itself publishes.

SCHEMA_ENCODING, MESSAGE_ENCODING = "ros2msg", "cdr"
"""As MCAP and Foxglove's protocol name them."""


def require_rosbags() -> None:
    """Check that messages can be encoded.

    Raises:
        InputError: rosbags is not installed.
    """
    if find_spec("rosbags") is None:
        raise InputError("ROS messages need rosbags; install it: pip install 'aquaflow[recording]'")


@cache
def _store() -> Any:
    require_rosbags()
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def message(name: str, /, **fields: Any) -> Any:
    """A message of the type ``name``, such as ``geometry_msgs/msg/Point``, with all its fields.

    Raises:
        InputError: rosbags is not installed.
    """
    return _store().types[name](**fields)


def constant(name: str, constant: str) -> Any:
    """The value of a constant in a message's definition, such as ``PointField.FLOAT32``."""
    return getattr(_store().types[name], constant)


@cache
def definition(name: str) -> bytes:
    """The definition of ``name`` and of what it refers to, one ``.msg`` text after the other: the
    schema ``ros2msg`` of MCAP."""
    text, _ = _store().generate_msgdef(name, ros_version=2)
    return str(text).encode()


def encode(message: Any) -> bytes:
    """The message as CDR, little endian."""
    return bytes(_store().serialize_cdr(message, message.__msgtype__))


# --------------------------------------------------------------------------------------------------
# The frames of reference of a dive by REP-103 and REP-105, which ROS and Foxglove go by.
#
# - ``map``: the upright frame of all exports: x east, y north, z up where true north is known.
# - ``base_link``: the vehicle's body, x forward, y left, z up; only where the mounting is known.
# - ``camera``: the camera's body, x forward (into the scene), y left, z up.
# - ``camera_optical``: z forward, x right, y down, as pictures and AquaFlow have it.
#
# There is no ``odom``: the poses of a dive are those of the map, corrected.

MAP, BODY, CAMERA_FRAME, OPTICAL = "map", "base_link", "camera", "camera_optical"

CAMERA_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Forward, left, up from right, down, forward (REP-103, suffix frames)."""
BODY_FROM_FRD = np.diag([1.0, -1.0, -1.0])
"""Forward, left, up from forward, right, down."""


@dataclass(frozen=True)
class FrameTransform:
    """A frame in its parent; ``T`` takes coordinates of ``child`` to those of ``parent``, rigid."""

    parent: str
    child: str
    T: Sim3


class FrameTree:
    """From ``map`` down to ``camera_optical``; every frame has one parent."""

    def __init__(self, frame: WorldFrame, where: Placement) -> None:
        """``frame`` is that of the sub-map, ``where`` how it is placed upright."""
        self._T_un = where.T_un
        camera = FrameTransform(CAMERA_FRAME, OPTICAL, Sim3(CAMERA_FROM_OPTICAL, np.zeros(3)))
        self._moving, self.fixed = CAMERA_FRAME, [camera]
        if frame.T_bc is not None:
            # Lengths of the mounting are metres; of a map in map units its place is unknown.
            t = frame.T_bc.t if frame.metric else np.zeros(3)
            T_bo = Sim3(BODY_FROM_FRD @ frame.T_bc.R, BODY_FROM_FRD @ t)
            self._moving = BODY
            self.fixed = [FrameTransform(BODY, CAMERA_FRAME, T_bo @ camera.T.inverse()), camera]

    def moving(self, T_nc: Sim3) -> FrameTransform:
        """The link that moves, for a pose of the camera in n."""
        T_uo = self._T_un @ Sim3(T_nc.R, T_nc.t)
        T = T_uo
        for link in reversed(self.fixed):
            T = T @ link.T.inverse()
        return FrameTransform(MAP, self._moving, T)
