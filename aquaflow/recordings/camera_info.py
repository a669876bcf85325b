"""CameraInfo of ROS: which one belongs to a picture topic, and what its pictures are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.foreign_calibration import MODELS

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
"""Message with a camera's calibration."""
TRANSPORTS = ("/compressed", "/compressedDepth", "/theora", "/ffmpeg")
"""What image_transport appends to a picture topic."""
NOT_SCENES = ("depth", "disparity", "mask", "segment", "confidence", "infra", "thermal", "sonar")
"""Parts of the names of topics whose pictures are not what a colour camera saw."""


def choose_topic(topics: Iterable[tuple[str, int]]) -> str | None:
    """Of picture topics with their counts, the one to map: pictures of the scene before depth,
    the one with the most messages, the first by name."""
    ranked = sorted(
        (any(part in topic.lower() for part in NOT_SCENES), -count, topic)
        for topic, count in topics
    )
    return ranked[0][2] if ranked else None


def is_rectified(topic: str) -> bool:
    """True for pictures of image_proc, whose camera is P and has no distortion (REP 104)."""
    return "rect" in _plain(topic).rpartition("/")[2].lower()


def info_topic(topic: str, infos: Iterable[str]) -> str | None:
    """Of CameraInfo topics, that of a picture topic: beside it, else in the nearest namespace."""
    known = sorted(set(infos), key=lambda each: (not each.endswith("/camera_info"), each))
    namespace = _plain(topic).rpartition("/")[0]
    while True:
        for info in known:
            if info.rpartition("/")[0] == namespace:
                return info
        if not namespace:
            return None
        namespace = namespace.rpartition("/")[0]


def camera_of_info(info: Any, rectified: bool) -> CameraModel | str:
    """The camera of the pictures beside the message, or why there is none.

    K and P are of the whole sensor; pictures may be a part of it (``roi``), then binned (REP 104,
    sensor_msgs/CameraInfo). ROS counts pixel centres as integers, we do not.
    """
    fields = {name.lower(): value for name, value in vars(info).items()}
    k, p = np.asarray(fields["k"], np.float64), np.asarray(fields["p"], np.float64)
    d = tuple(float(value) for value in fields["d"])
    model = MODELS.get(str(info.distortion_model).lower())
    if rectified and p[0] > 0.0:
        fx, fy, cx, cy = p[0], p[5], p[2], p[6]
    else:
        fx, fy, cx, cy = k[0], k[4], k[2], k[5]
    if not (fx > 0.0 and fy > 0.0):
        return "its focal length is not above zero: it was never calibrated"
    if rectified:
        model, d = "none", ()
    elif model in (None, "none") and any(d):
        return f"its distortion model '{info.distortion_model}' is not known"
    elif model is None or not d:
        model, d = "none" if model != "fisheye" else model, ()
    roi = info.roi
    width, height = int(roi.width) or int(info.width), int(roi.height) or int(info.height)
    bx, by = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    return CameraModel(
        width // bx, height // by, float(fx) / bx, float(fy) / by,
        (float(cx) + 0.5 - int(roi.x_offset)) / bx, (float(cy) + 0.5 - int(roi.y_offset)) / by,
        model, d,
    )  # fmt: skip


def _plain(topic: str) -> str:
    for transport in TRANSPORTS:
        topic = topic.removesuffix(transport)
    return topic
