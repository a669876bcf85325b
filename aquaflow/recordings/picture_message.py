"""Pictures inside messages of MCAP files and ROS bags, whatever their names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.foreign_calibration import MODELS
from aquaflow.recordings.picture import Stored, UnreadablePictureError, to_rgb

PACKED = re.compile(r"(mono|rgba|rgb|bgra|bgr)(8|16)|(8|16)uc([134])")
"""Channels beside each other, 8 or 16 bits each (sensor_msgs/image_encodings.h); those named by
types of OpenCV have its order, blue first."""
BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")
SECOND_ROW = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
"""OpenCV names a pattern by its second row."""
PAIRS = {
    "yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2",
}  # fmt: skip
"""4:2:2, two bytes a pixel: colour first in ``yuv422``, as ROS has it, luma first in YUY2."""
PLANES = {"nv12": "NV12", "nv21": "NV21"}
"""4:2:0: luma, then half as many rows of colour."""


def raw_picture(
    data: bytes, height: int, width: int, step: int, encoding: str, big_endian: bool = False
) -> Stored:
    """The pixels of a foxglove.RawImage or a sensor_msgs/Image.

    ``step`` is the length of a row in bytes; ``big_endian`` the order of 16-bit numbers.

    Raises:
        UnreadablePictureError: the encoding is not known, or data are missing.
    """
    name = encoding.lower()
    packed, bayer = PACKED.fullmatch(name), BAYER.fullmatch(name)
    if packed is None and bayer is None and name not in {*PAIRS, *PLANES}:
        raise UnreadablePictureError(f"has pixels of encoding '{encoding}'")
    try:
        if name in PLANES:
            return _from_yuv(_rows(data, height * 3 // 2, step)[:, :width], PLANES[name])
        rows = _rows(data, height, step)
        if name in PAIRS:
            return _from_yuv(rows[:, : 2 * width].reshape(height, width, 2), PAIRS[name])
        if bayer is not None:
            pattern = _numbers(rows, width, int(bayer[2]), big_endian)
            return _as_stored(_from_bayer(pattern, SECOND_ROW[bayer[1]]))
        assert packed is not None
        return _from_packed(rows, width, packed, big_endian)
    except ValueError:
        raise UnreadablePictureError("holds fewer pixels than it says") from None


def _rows(data: bytes, height: int, step: int) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)[: height * step].reshape(height, step)


def _from_packed(
    rows: npt.NDArray[np.uint8],  # [H, step]
    width: int,
    name: re.Match[str],
    big_endian: bool,
) -> Stored:
    """Of what ``PACKED`` matches."""
    order = name[1] or {"1": "mono", "3": "bgr", "4": "bgra"}[name[4]]
    channels = {"mono": 1, "rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}[order]
    numbers = _numbers(rows, width * channels, int(name[2] or name[3]), big_endian)
    picture = numbers.reshape(len(rows), width, channels)
    if channels == 1:
        return _as_stored(picture[..., 0])
    return _as_stored(picture[..., 2::-1] if order.startswith("bgr") else picture[..., :3])


def _numbers(
    rows: npt.NDArray[np.uint8],  # [H, step]
    count: int,
    bits: int,
    big_endian: bool,
) -> npt.NDArray[np.uint8 | np.uint16]:
    """[H, count] of each row."""
    if bits == 8:
        return rows[:, :count]
    stored = rows[:, : 2 * count].copy().view(">u2" if big_endian else "<u2")
    return stored.astype(np.uint16)


def _as_stored(
    picture: npt.NDArray[np.uint8 | np.uint16],  # [H, W] or [H, W, 3]
) -> Stored:
    if picture.dtype == np.uint8:
        return to_rgb(picture.astype(np.uint8, copy=False), 1)
    return picture.astype(np.int32)


def _from_bayer(
    pattern: npt.NDArray[np.uint8 | np.uint16],  # [H, W]
    second_row: str,
) -> npt.NDArray[np.uint8 | np.uint16]:
    import cv2

    code = getattr(cv2, f"COLOR_Bayer{second_row}2RGB")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pattern), code), pattern.dtype)


def _from_yuv(
    pixels: npt.NDArray[np.uint8],  # [H, W, 2], or [H * 3 / 2, W] of planes
    layout: str,
) -> npt.NDArray[np.uint8]:
    import cv2

    code = getattr(cv2, f"COLOR_YUV2RGB_{layout}")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), np.uint8)


# --------------------------------------------------------------------------------------------------
# Which topic holds them, and what their CameraInfo says.

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
