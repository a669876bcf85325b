"""Where the bytes of a picture lie: in one piece, or a piece for each of its planes.

The kernel has two sets of structures for this, chosen by the type of a buffer; a driver offers one
of them.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Protocol

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.v4l2 import abi, abi_planes
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

    kind = abi_planes.VIDEO_CAPTURE_MPLANE

    def __init__(self) -> None:
        self._count = 1

    def negotiate_format(
        self, system: KernelInterface, fd: int, config: V4l2Config
    ) -> PictureFormat:
        wanted = abi.Format(type=self.kind)
        pix = abi_planes.PixFormatMplane.from_buffer(wanted.fmt.raw)
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
        buffer.planes = (abi_planes.Plane * self._count)()
        buffer.offset = ctypes.addressof(buffer.planes)
        buffer.length = self._count
        return buffer

    def places(self, buffer: abi.Buffer) -> list[tuple[int, int]]:
        return [(int(plane.length), plane.offset & 0xFFFFFFFF) for plane in buffer.planes]

    def picture_slices(self, buffer: abi.Buffer) -> list[slice]:
        return [slice(int(plane.data_offset), int(plane.bytesused)) for plane in buffer.planes]
