"""JPEG files as cameras deliver them, by USB or as motion JPEG over the network."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.drivers.capture import UnusablePictureError

JPEG_START = b"\xff\xd8"
"""SOI, the marker that a JPEG file begins with."""


def jpeg_to_rgb(
    data: npt.NDArray[np.uint8],  # [bytes used]
    width: int,
    height: int,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] RGB in memory of its own.

    Raises:
        UnusablePictureError: it is damaged, or not of the size that the camera announced.
    """
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
