"""Where the bytes of a picture lie: in one piece, or a piece for each of its planes.

The kernel has two sets of structures for this, chosen by the type of a buffer; a driver offers one
of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.capture import UnusablePictureError
from aquaflow.drivers.jpeg import jpeg_to_rgb
from aquaflow.drivers.v4l2 import abi
from aquaflow.drivers.v4l2.system import KernelInterface, call


@dataclass(frozen=True)
class PictureFormat:
    """What the driver settled on."""

    pixels: str
    """Four letters, as the kernel names it."""
    width: int
    height: int
    strides: tuple[int, ...]
    """Bytes from row to row, for each piece of memory."""


class BufferLayout(Protocol):
    """One of the two sets of structures."""

    kind: int
    """V4L2_BUF_TYPE_*."""

    def negotiate_format(
        self, system: KernelInterface, fd: int, config: V4l2Config
    ) -> PictureFormat:
        """Ask for a format, and take what the driver makes of it."""
        ...

    def buffer(self, index: int = 0) -> abi.Buffer:
        """The structure that describes a buffer to the kernel, and that it fills."""
        ...

    def places(self, buffer: abi.Buffer) -> list[tuple[int, int]]:
        """Length and offset of each piece of memory."""
        ...

    def picture_slices(self, buffer: abi.Buffer) -> list[slice]:
        """Of each piece, the bytes that are of the picture."""
        ...


def layout_of(capabilities: int) -> BufferLayout:
    """By what a node says that it can."""
    single = capabilities & abi.CAP_VIDEO_CAPTURE
    return SinglePlanar() if single else MultiPlanar()


class SinglePlanar:
    """Pictures in one piece."""

    kind = abi.VIDEO_CAPTURE

    def negotiate_format(
        self, system: KernelInterface, fd: int, config: V4l2Config
    ) -> PictureFormat:
        wanted = abi.Format(type=self.kind)
        pix = wanted.fmt.pix
        pix.width, pix.height = config.width, config.height
        pix.pixelformat = abi.fourcc(config.pixels)
        call(system, fd, abi.S_FMT, wanted)
        name = abi.name_of(pix.pixelformat)
        return PictureFormat(name, int(pix.width), int(pix.height), (int(pix.bytesperline),))

    def buffer(self, index: int = 0) -> abi.Buffer:
        return abi.Buffer(index=index, type=self.kind, memory=abi.MEMORY_MMAP)

    def places(self, buffer: abi.Buffer) -> list[tuple[int, int]]:
        return [(int(buffer.length), buffer.offset & 0xFFFFFFFF)]

    def picture_slices(self, buffer: abi.Buffer) -> list[slice]:
        return [slice(0, int(buffer.bytesused))]


class MultiPlanar:
    """Pictures in as many pieces as the driver says."""

    kind = abi.VIDEO_CAPTURE_MPLANE

    def __init__(self) -> None:
        self._count = 1

    def negotiate_format(
        self, system: KernelInterface, fd: int, config: V4l2Config
    ) -> PictureFormat:
        wanted = abi.Format(type=self.kind)
        pix = abi.PixFormatMplane.from_buffer(wanted.fmt.raw)
        pix.width, pix.height = config.width, config.height
        pix.pixelformat = abi.fourcc(config.pixels)
        call(system, fd, abi.S_FMT, wanted)
        self._count = int(pix.num_planes)
        strides = tuple(int(pix.plane_fmt[plane].bytesperline) for plane in range(self._count))
        name = abi.name_of(pix.pixelformat)
        return PictureFormat(name, int(pix.width), int(pix.height), strides)

    def buffer(self, index: int = 0) -> abi.Buffer:
        buffer = abi.Buffer(index=index, type=self.kind, memory=abi.MEMORY_MMAP)
        # The kernel writes to where the structure points; it lives as long as the structure.
        buffer.planes = (abi.Plane * self._count)()
        buffer.offset = ctypes.addressof(buffer.planes)
        buffer.length = self._count
        return buffer

    def places(self, buffer: abi.Buffer) -> list[tuple[int, int]]:
        return [(int(plane.length), plane.offset & 0xFFFFFFFF) for plane in buffer.planes]

    def picture_slices(self, buffer: abi.Buffer) -> list[slice]:
        return [slice(int(plane.data_offset), int(plane.bytesused)) for plane in buffer.planes]


# --------------------------------------------------------------------------------------------------
# What cameras deliver, as RGB.

PACKED = {"YUYV": "COLOR_YUV2RGB_YUYV", "UYVY": "COLOR_YUV2RGB_UYVY"}
"""Two bytes a pixel, by OpenCV's name of the conversion."""
HALF_COLOURED = frozenset({"NV12", "NM12"})
"""A byte a pixel, then a pair of colours for four; NM12 has these in memory of their own."""
STREAMED = "H264"
"""Pictures that need those before them (:mod:`aquaflow.drivers.v4l2.capture`)."""

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
