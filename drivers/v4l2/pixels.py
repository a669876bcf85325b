"""What cameras deliver, as RGB."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.drivers.capture import UnusablePictureError
from aquaflow.drivers.jpeg import jpeg_to_rgb
from aquaflow.drivers.v4l2.planes import PictureFormat

PACKED = {"YUYV": "COLOR_YUV2RGB_YUYV", "UYVY": "COLOR_YUV2RGB_UYVY"}
"""Two bytes a pixel, by OpenCV's name of the conversion."""
HALF_COLOURED = frozenset({"NV12", "NM12"})
"""A byte a pixel, then a pair of colours for four; NM12 has these in memory of their own."""
STREAMED = "H264"
"""Pictures that need those before them (:mod:`aquaflow.drivers.v4l2.camera`)."""

JPEG_PIXELS = frozenset({"MJPG", "JPEG"})
"""V4L2's two names of a picture that is a JPEG file."""

Bytes = npt.NDArray[np.uint8]


def to_rgb(
    data: Sequence[npt.NDArray[np.uint8]],  # of each piece of memory [bytes used]
    form: PictureFormat,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] RGB in memory of its own, from rows of bytes or from a JPEG.

    Raises:
        UnusablePictureError: the data is cut off or damaged, or the pixels are not known.
    """
    import cv2

    if form.pixels in JPEG_PIXELS:
        return jpeg_to_rgb(data[0], form.width, form.height)
    if form.pixels == "GREY":
        return np.repeat(_rows(data[0], form, 0, form.height, form.width)[:, :, None], 3, axis=2)
    if form.pixels in PACKED:
        rows = _rows(data[0], form, 0, form.height, 2 * form.width)
        # OpenCV wants rows without padding; where there is none, this copies nothing.
        packed = np.ascontiguousarray(rows).reshape(form.height, form.width, 2)
        return np.asarray(cv2.cvtColor(packed, getattr(cv2, PACKED[form.pixels])), np.uint8)
    if form.pixels in HALF_COLOURED:
        planes = np.concatenate(_brightness_and_colours(data, form))
        return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_NV12), np.uint8)
    raise UnusablePictureError(f"has pixels of type {form.pixels}, which are not read")


def _brightness_and_colours(
    data: Sequence[Bytes],  # of each piece of memory [bytes used]
    form: PictureFormat,
) -> list[Bytes]:
    """[H, W] and [H / 2, W], from one piece of memory or from two."""
    height, width = form.height, form.width
    if len(data) > 1:
        rows = _rows(data[1], form, 1, height // 2, width)
        return [_rows(data[0], form, 0, height, width), rows]
    both = _rows(data[0], form, 0, height + height // 2, width)
    return [both[:height], both[height:]]


def _rows(
    data: Bytes,  # [bytes used]
    form: PictureFormat,
    plane: int,
    count: int,
    wide: int,
) -> Bytes:
    """[count, wide] without what pads the rows."""
    stride = form.strides[plane]
    if data.size < stride * count:
        raise UnusablePictureError(f"is cut off after {data.size} of {stride * count} bytes")
    return data[: stride * count].reshape(count, stride)[:, :wide]
