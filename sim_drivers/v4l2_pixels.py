"""Pictures as the bytes that a simulated V4L2 camera delivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.sim_drivers.h264_writer import access_unit

JPEG_QUALITY = 95
"""Percent, OpenCV's own default."""

ROW_BYTES = {"YUYV": 2, "UYVY": 2, "GREY": 1, "NV12": 1, "NM12": 1}
"""For each pixel of a row."""
HALF_COLOURED = ("NV12", "NM12")
"""Half as many rows of colours follow; NM12's lie in memory of their own."""

Bytes = npt.NDArray[np.uint8]


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
        """Bytes from row to row; 0 for what is compressed."""
        width = ROW_BYTES.get(self.pixels, 0) * self.width
        return width + self.padding if width else 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the pieces of memory that hold any picture of this format."""
        brightness, colours = self.stride * self.height, self.stride * self.height // 2
        if self.pixels == "NM12":
            return brightness, colours
        if self.pixels == "NV12":
            return (brightness + colours,)
        return (brightness or self.width * self.height * 3,)


def encode(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    form: PixelFormat,
    number: int,
    corrupt: bool,
) -> tuple[list[npt.NDArray[np.uint8]], bool]:
    """The bytes of each piece, and whether the kernel would have noticed the damage."""
    if form.pixels in ("MJPG", "H264"):
        # It is cut where a USB packet got lost; the kernel does not look into it.
        whole = _jpeg(image) if form.pixels == "MJPG" else _h264(image, number)
        return [whole[2:] if corrupt else whole], False
    rows = np.concatenate([_pad(each, form) for each in _planes(image, form)])
    parts = [rows] if len(form.sizes) == 1 else [rows[: form.height], rows[form.height :]]
    return [part.reshape(-1) for part in parts], corrupt


def _jpeg(
    image: Bytes,  # [H, W, 3] RGB
) -> Bytes:
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)
    return np.asarray(jpeg, np.uint8).reshape(-1)


def _h264(
    image: Bytes,  # [H, W, 3] RGB
    number: int,
) -> Bytes:
    return np.frombuffer(access_unit(image, number), np.uint8)


def _planes(
    image: Bytes,  # [H, W, 3] RGB
    form: PixelFormat,
) -> list[Bytes]:
    """Rows of bytes, one after the other in memory."""
    import cv2

    height, width = image.shape[:2]
    if form.pixels == "GREY":
        return [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)]
    if form.pixels in HALF_COLOURED:
        planar = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), np.uint8)
        halves = planar[height:].reshape(2, -1)
        return [planar[:height], np.stack(list(halves), -1).reshape(height // 2, width)]
    code = cv2.COLOR_RGB2YUV_YUYV if form.pixels == "YUYV" else cv2.COLOR_RGB2YUV_UYVY
    return [np.asarray(cv2.cvtColor(image, code), np.uint8).reshape(height, -1)]


def _pad(
    plane: Bytes,  # [rows, bytes]
    form: PixelFormat,
) -> Bytes:
    rows = np.zeros((len(plane), form.stride), np.uint8)
    rows[:, : plane.shape[1]] = plane
    return rows
