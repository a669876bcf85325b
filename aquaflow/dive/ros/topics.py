"""The topics of a dive: the same in an exported MCAP file and in a live connection."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any

from aquaflow.base.errors import InputError

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
