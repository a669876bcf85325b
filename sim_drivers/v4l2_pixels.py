"""Pictures as the bytes that a simulated V4L2 camera delivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

JPEG_QUALITY = 95
"""Percent, OpenCV's own default."""


@dataclass(frozen=True)
class PixelFormat:
    """What S_FMT settled on."""

    pixels: str
    width: int
    height: int
    padding: int
    """Bytes after each row that is not compressed."""

    @property
    def stride(self) -> int:
        """Bytes from row to row; 0 for JPEG."""
        width = {"YUYV": 2, "GREY": 1}.get(self.pixels, 0) * self.width
        return width + self.padding if width else 0

    @property
    def image_bytes(self) -> int:
        """Size of a buffer that holds any picture of this format."""
        return self.stride * self.height or self.width * self.height * 3


def encoded(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    form: PixelFormat,
    corrupt: bool,
) -> tuple[npt.NDArray[np.uint8], bool]:
    """The bytes, and whether the kernel would have noticed the damage."""
    import cv2

    if form.pixels == "MJPG":
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)
        # A JPEG is cut where a USB packet got lost; the kernel does not look into it.
        return (jpeg[2:] if corrupt else jpeg), False
    if form.pixels == "GREY":
        packed = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    else:
        packed = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_YUYV).reshape(form.height, -1)
    rows = np.zeros((form.height, form.stride), np.uint8)
    rows[:, : packed.shape[1]] = packed
    return rows.reshape(-1), corrupt
