"""The simulated V4L2 camera with the multi-planar API, as boards' own cameras have it."""

from __future__ import annotations

import ctypes
import errno
import struct
from collections.abc import Sequence

from aquaflow.sim_drivers.v4l2_kernel import PAGE_BITS, V4l2Kernel, refusal

PLANE_BYTES = 64
"""Size of ``struct v4l2_plane``: bytes used, length, offset of the memory, offset of the data."""
FORMAT_BYTES = 20
"""Size of ``struct v4l2_plane_pix_format``: size, bytes of a row."""
DATA_OFFSET = 16
"""Bytes at the start of each piece of memory that are not of the picture: some drivers' headers."""


class MultiPlanarKernel(V4l2Kernel):
    """Its structures point to one ``struct v4l2_plane`` for each piece of memory."""

    capture_caps = 0x04000000 | 0x00001000
    buffer_type = 9

    def _show_layout(self, data: memoryview) -> None:
        """``struct v4l2_pix_format_mplane``."""
        for plane, size in enumerate(self._format.sizes):
            at = 28 + FORMAT_BYTES * plane
            struct.pack_into("II", data, at, size + DATA_OFFSET, self._format.stride)
        struct.pack_into("B", data, 188, len(self._format.sizes))

    def _request_buffers(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        (count,) = struct.unpack_from("I", data)
        self._buffers.request(count, [size + DATA_OFFSET for size in self._format.sizes])

    def _show_places(self, data: memoryview, index: int) -> None:
        pieces = len(self._format.sizes)
        for plane, memory in enumerate(self._planes(data)):
            size = self._format.sizes[plane] + DATA_OFFSET
            place = (index * pieces + plane) << PAGE_BITS
            struct.pack_into("=IQ", memory, 4, size, place)

    def _show_used(self, data: memoryview, used: Sequence[int]) -> None:
        (index,) = struct.unpack_from("I", data)
        for plane, (memory, size) in enumerate(zip(self._planes(data), used, strict=True)):
            struct.pack_into("I", memory, 0, size + DATA_OFFSET)
            struct.pack_into("I", memory, 16, DATA_OFFSET)
            piece = self._buffers.memory[index * len(used) + plane]
            piece[DATA_OFFSET : DATA_OFFSET + size] = piece[:size].copy()
            piece[:DATA_OFFSET] = 0

    def _queue(self, fd: int, data: memoryview) -> None:
        self._planes(data)
        super()._queue(fd, data)

    def _planes(self, data: memoryview) -> list[memoryview]:
        """What the structure points to; EINVAL without room for every plane."""
        address, count = struct.unpack_from("QI", data, 64)
        pieces = len(self._format.sizes)
        if count < pieces or not address:
            raise refusal(errno.EINVAL)
        memory = (ctypes.c_uint8 * (PLANE_BYTES * pieces)).from_address(address)
        whole = memoryview(memory).cast("B")
        return [whole[at : at + PLANE_BYTES] for at in range(0, PLANE_BYTES * pieces, PLANE_BYTES)]
