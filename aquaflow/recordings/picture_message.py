"""Pictures inside messages of MCAP files and ROS bags, whatever their names: to RGB."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.recordings.picture import (
    UnreadablePictureError,
    decode_picture,
    to_rgb,
    white_of_16,
)

CHANNELS = {
    "rgb8": 3, "8uc3": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8uc1": 1,
}  # fmt: skip
"""Bytes a pixel of the encodings with one byte a channel (sensor_msgs/image_encodings.h)."""

GREY_16 = frozenset({"mono16", "16uc1"})
"""Names of 16-bit grey, in small letters."""
BAYER = {"bayer_rggb8": "BG", "bayer_bggr8": "RG", "bayer_gbrg8": "GR", "bayer_grbg8": "GB"}
"""OpenCV names a pattern by its second row."""
YUYV = frozenset({"yuv422_yuy2", "yuyv"})
"""Names of 4:2:2 pictures that begin with luma."""


def compressed_picture(data: bytes) -> npt.NDArray[np.uint8]:
    """A whole JPEG, PNG or other picture file as [H, W, 3] RGB.

    Raises:
        UnreadablePictureError: it is damaged.
    """
    picture = decode_picture(data)
    return to_rgb(picture, white_of_16(picture))


def raw_picture(
    data: bytes, height: int, width: int, step: int, encoding: str
) -> npt.NDArray[np.uint8]:
    """The pixels of a foxglove.RawImage or a sensor_msgs/Image as [H, W, 3] RGB.

    Raises:
        UnreadablePictureError: the encoding is not known, or data are missing.
    """
    name = encoding.lower()
    try:
        rows = np.frombuffer(data, np.uint8)[: height * step].reshape(height, step)
        if name in GREY_16:
            grey = rows[:, : 2 * width].copy().view("<u2").astype(np.int32)
            return to_rgb(grey, white_of_16(grey))
        if name in BAYER or name in YUYV:
            return _convert(rows, height, width, name)
        channels = CHANNELS[name]
        picture = rows[:, : channels * width].reshape(height, width, channels)
    except KeyError:
        raise UnreadablePictureError(f"has pixels of encoding '{encoding}'") from None
    except ValueError:
        raise UnreadablePictureError("holds fewer pixels than it says") from None
    if channels == 1:
        return np.repeat(picture, 3, axis=2)
    ordered = picture[..., 2::-1] if name.startswith("bgr") else picture[..., :3]
    return np.ascontiguousarray(ordered)


def _convert(
    rows: npt.NDArray[np.uint8],  # [H, step]
    height: int,
    width: int,
    name: str,
) -> npt.NDArray[np.uint8]:
    import cv2

    if name in YUYV:
        pixels = np.ascontiguousarray(rows[:, : 2 * width]).reshape(height, width, 2)
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_YUY2), np.uint8)
    pattern = np.ascontiguousarray(rows[:, :width])
    code = getattr(cv2, f"COLOR_Bayer{BAYER[name]}2RGB")
    return np.asarray(cv2.cvtColor(pattern, code), np.uint8)
