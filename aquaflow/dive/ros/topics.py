"""The topics of a dive: the same in an exported MCAP file and in a live connection."""

from __future__ import annotations

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
