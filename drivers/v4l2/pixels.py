"""What cameras deliver, as RGB."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.drivers.capture import UnusablePictureError

BYTES_PER_PIXEL = {"YUYV": 2, "GREY": 1}
"""Of the formats that are not compressed."""

JPEG_PIXELS = frozenset({"MJPG", "JPEG"})
"""V4L2's two names of a picture that is a JPEG file."""
JPEG_START = b"\xff\xd8"
"""SOI, the marker that a JPEG file begins with."""


def to_rgb(
    data: npt.NDArray[np.uint8],  # [bytes used]
    pixels: str,
    width: int,
    height: int,
    stride: int,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] RGB in memory of its own, from rows of ``stride`` bytes or from a JPEG.

    Raises:
        UnusablePictureError: the data is cut off or damaged, or ``pixels`` is not known.
    """
    if pixels in JPEG_PIXELS:
        return _jpeg_to_rgb(data, width, height)
    if pixels not in BYTES_PER_PIXEL:
        raise UnusablePictureError(f"has pixels of type {pixels}, which are not read")
    import cv2

    if data.size < stride * height:
        raise UnusablePictureError(f"is cut off after {data.size} of {stride * height} bytes")
    rows = data[: stride * height].reshape(height, stride)
    rows = rows[:, : width * BYTES_PER_PIXEL[pixels]]
    if pixels == "GREY":
        return np.repeat(rows[:, :, None], 3, axis=2)
    # OpenCV wants rows without padding; where there is none, this copies nothing.
    packed = np.ascontiguousarray(rows).reshape(height, width, 2)
    return np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2RGB_YUYV), np.uint8)


def _jpeg_to_rgb(
    data: npt.NDArray[np.uint8],  # [bytes used]
    width: int,
    height: int,
) -> npt.NDArray[np.uint8]:
    import cv2

    # Without its start OpenCV would search for other formats, and write to stderr about it.
    if data[:2].tobytes() != JPEG_START:
        raise UnusablePictureError("is no JPEG picture")
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    except cv2.error as error:
        raise UnusablePictureError("is a damaged JPEG picture") from error
    if image is None:
        raise UnusablePictureError("is a damaged JPEG picture")
    if image.shape != (height, width, 3):
        raise UnusablePictureError(
            f"is {image.shape[1]} x {image.shape[0]} px where the camera announced "
            f"{width} x {height}"
        )
    return np.asarray(image, np.uint8)
