"""A kernel with one V4L2 camera, as :class:`aquaflow.drivers.v4l2.system.KernelInterface` sees it.

It reads and writes the bytes of the ioctls' structures by the offsets of linux/videodev2.h, knows
nothing of the driver, and refuses what the real one refuses: pictures before STREAMON, a buffer
queued twice, a device that is gone. Nodes and udev's links are real files below ``root``.
"""

from __future__ import annotations

import errno
import os
import shutil
import struct
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.h264_writer import PixelFormat, encode

QUERYCAP, ENUM_FMT, S_FMT, REQBUFS, QUERYBUF, QBUF, DQBUF = 0, 2, 5, 8, 9, 15, 17
STREAMON, STREAMOFF, S_PARM, G_CTRL, S_CTRL, QUERYCTRL, ENUM_FRAMESIZES = 18, 19, 22, 27, 28, 36, 74
"""Numbers of the requests, VIDIOC_* of linux/videodev2.h."""

CAPS = 0x80000000
"""V4L2_CAP_DEVICE_CAPS: beside all, the device says what each node can."""
CAPTURE_CAPS = 0x04000000 | 0x00000001
"""Of the node that takes pictures: STREAMING and VIDEO_CAPTURE."""
VIDEO_CAPTURE = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE; every call that is about buffers names the type."""
METADATA_CAPS = 0x04000000 | 0x00800000
"""Of the second node that UVC cameras have: STREAMING and META_CAPTURE."""
MONOTONIC_START_OF_EXPOSURE = 0x2000 | 0x10000
"""V4L2_BUF_FLAG_*: the stamp's clock, and what is stamped."""
ERROR = 0x0040
"""V4L2_BUF_FLAG_ERROR."""

EXPOSURE_ABSOLUTE, WHITE_BALANCE = 0x009A0902, 0x0098091A
"""V4L2_CID_*: the controls that the camera has by default."""


@dataclass
class CameraSpec:
    """The simulated camera."""

    name: str = "Simulated USB camera"
    serial: str = "SIM0001"
    bus: str = "usb-0000:00:14.0-1"
    pixels: tuple[str, ...] = ("YUYV", "MJPG", "GREY", "UYVY", "NV12", "H264")
    controls: tuple[int, ...] = (EXPOSURE_ABSOLUTE, WHITE_BALANCE)
    """Those that exist, each from 1 to 10000; all others are refused."""
    padding: int = 0
    """Bytes after each row of an uncompressed picture."""
    interrupts: int = 0
    """So many of the next calls are interrupted by a signal."""


class V4l2Kernel:
    """Shows a feed as a camera; when the feed unplugs it, it returns under another number."""

    capture_caps = CAPTURE_CAPS
    buffer_type = VIDEO_CAPTURE

    def __init__(self, root: Path, feed: CameraFeed, spec: CameraSpec | None = None) -> None:
        self.root = root
        self.feed = feed
        self.spec = spec or CameraSpec()
        self.controls: dict[int, int] = dict.fromkeys(self.spec.controls, 5000)
        self._descriptors: dict[int, str] = {}
        self._next_fd = 1000
        self._number = -2
        self._present = False
        self._owner: int | None = None
        self._format = PixelFormat("YUYV", *self._size(), 0)
        self._buffers = Buffers()
        self._plug_in()

    def unplug(self) -> None:
        """Take the camera away, until it is plugged in. Its nodes go; the number stays taken while
        a descriptor is open, so the next is new."""
        self._present = False
        for node in self._nodes():
            (self.root / "dev" / node).unlink()
            shutil.rmtree(self.root / "sys/class/video4linux" / node)
        for link in (self.root / "dev/v4l/by-id").glob(f"usb-{self.spec.serial}-*"):
            link.unlink()

    def plug_in(self) -> None:
        """Bring a camera back that was unplugged."""
        self.feed.come_back()
        self._plug_in()

    def open(self, path: str) -> int:
        if not Path(path).exists():
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        self._next_fd += 1
        self._descriptors[self._next_fd] = Path(path).name
        return self._next_fd

    def close(self, fd: int) -> None:
        del self._descriptors[fd]
        if fd == self._owner:
            self._owner, self._buffers = None, Buffers()

    def wait(self, fd: int, timeout_s: float) -> bool:
        if self._is_gone(fd):
            return True
        return self.feed.wait(timeout_s)

    def mmap(self, fd: int, length: int, offset: int) -> npt.NDArray[np.uint8]:
        return self._buffers.memory[offset >> PAGE_BITS][:length]

    def ioctl(self, fd: int, request: int, argument: Any) -> None:
        if self.spec.interrupts > 0:
            self.spec.interrupts -= 1
            raise InterruptedError(errno.EINTR, os.strerror(errno.EINTR))
        if self._is_gone(fd):
            raise refusal(errno.ENODEV)
        data = memoryview(argument).cast("B")
        assert len(data) == request >> 16 & 0x3FFF
        calls = {
            QUERYCAP: self._querycap, ENUM_FMT: self._enum_format, S_FMT: self._set_format,
            REQBUFS: self._request_buffers, QUERYBUF: self._query_buffer, QBUF: self._queue,
            DQBUF: self._dequeue, STREAMON: self._stream_on, STREAMOFF: self._stream_off,
            S_PARM: self._set_rate, G_CTRL: self._get_control, S_CTRL: self._set_control,
            QUERYCTRL: self._query_control, ENUM_FRAMESIZES: self._enum_sizes,
        }  # fmt: skip
        calls[request & 0xFF](fd, data)

    def _querycap(self, fd: int, data: memoryview) -> None:
        capture = self._descriptors[fd] == f"video{self._number}"
        node = self.capture_caps if capture else METADATA_CAPS
        name, bus = self.spec.name.encode(), self.spec.bus.encode()
        struct.pack_into(
            "16s32s32sIII", data, 0, b"uvcvideo", name, bus, 0x060100, CAPS | node, node
        )

    def _enum_format(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        (index,) = struct.unpack_from("I", data)
        if index >= len(self.spec.pixels):
            raise refusal(errno.EINVAL)
        data[44:48] = self.spec.pixels[index].encode()

    def _enum_sizes(self, fd: int, data: memoryview) -> None:
        (index,) = struct.unpack_from("I", data)
        if index > 0:
            raise refusal(errno.EINVAL)
        struct.pack_into("III", data, 8, 1, *self._size())

    def _set_format(self, fd: int, data: memoryview) -> None:
        """The size is the recording's, whatever was asked for; so is an unknown pixel format."""
        self._check_type(data)
        if self._owner not in (None, fd):
            raise refusal(errno.EBUSY)
        self._owner = fd
        asked = bytes(data[16:20]).decode("ascii", "replace")
        pixels = asked if asked in self.spec.pixels else self.spec.pixels[0]
        self._format = form = PixelFormat(pixels, *self._size(), self.spec.padding)
        struct.pack_into("II4s", data, 8, form.width, form.height, pixels.encode())
        self._show_layout(data)

    def _show_layout(self, data: memoryview) -> None:
        """Row and size of the settled format, into ``struct v4l2_format``."""
        struct.pack_into("II", data, 24, self._format.stride, self._format.sizes[0])

    def _set_rate(self, fd: int, data: memoryview) -> None:
        self._check_type(data)
        struct.pack_into("II", data, 12, 1, 30)

    def _request_buffers(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        (count,) = struct.unpack_from("I", data)
        self._buffers.request(count, self._format.sizes)

    def _query_buffer(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        self._show_places(data, self._buffers.existing(_index(data)))

    def _show_places(self, data: memoryview, index: int) -> None:
        """Where the buffer's memory is mapped, into ``struct v4l2_buffer``."""
        struct.pack_into("QI", data, 64, index << PAGE_BITS, self._format.sizes[0])

    def _show_used(self, data: memoryview, used: Sequence[int]) -> None:
        """How much of it a picture takes."""
        struct.pack_into("I", data, 8, used[0])

    def _queue(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        self._buffers.queue(_index(data))

    def _check_type(self, data: memoryview, at: int = 0) -> None:
        (kind,) = struct.unpack_from("I", data, at)
        if kind != self.buffer_type:
            raise refusal(errno.EINVAL)

    def _stream_on(self, fd: int, data: memoryview) -> None:
        self._check_type(data)
        self._buffers.start()

    def _stream_off(self, fd: int, data: memoryview) -> None:
        self._check_type(data)
        self._buffers.stop()

    def _dequeue(self, fd: int, data: memoryview) -> None:
        self._check_type(data, 4)
        if not self._buffers.ready() or not self.feed.wait(0.0):
            raise refusal(errno.EAGAIN)
        shot = self.feed.take()
        if shot.unplugged:
            self.unplug()
            again = threading.Timer(self.feed.faults.away_s, self._plug_in)
            again.daemon = True
            again.start()
            raise refusal(errno.ENODEV)
        payloads, damaged = encode(shot.image, self._format, shot.sequence, shot.corrupt)
        flags = MONOTONIC_START_OF_EXPOSURE | (ERROR if damaged else 0)
        struct.pack_into("I", data, 0, self._buffers.fill(payloads))
        struct.pack_into("I", data, 12, flags)
        self._show_used(data, [payload.size for payload in payloads])
        seconds, rest_ns = divmod(shot.exposed_ns, 1_000_000_000)
        struct.pack_into("qq", data, 24, seconds, rest_ns // 1000)
        struct.pack_into("I", data, 56, shot.sequence & 0xFFFFFFFF)

    def _get_control(self, fd: int, data: memoryview) -> None:
        (control,) = struct.unpack_from("I", data)
        struct.pack_into("i", data, 4, self._control_value(control))

    def _set_control(self, fd: int, data: memoryview) -> None:
        control, value = struct.unpack_from("Ii", data)
        self._control_value(control)
        self.controls[control] = value

    def _query_control(self, fd: int, data: memoryview) -> None:
        (control,) = struct.unpack_from("I", data)
        self._control_value(control)
        struct.pack_into("iiii", data, 40, 1, 10_000, 1, 5000)

    def _control_value(self, control: int) -> int:
        if control not in self.controls:
            raise refusal(errno.EINVAL)
        return self.controls[control]

    def _size(self) -> tuple[int, int]:
        height, width = self.feed.peek().image.shape[:2]
        return width, height

    def _is_gone(self, fd: int) -> bool:
        return not self._present or self._descriptors[fd] not in self._nodes()

    def _nodes(self) -> tuple[str, str]:
        """Of one camera: pictures and metadata."""
        return f"video{self._number}", f"video{self._number + 1}"

    def _plug_in(self) -> None:
        self._number += 2
        by_id = self.root / "dev/v4l/by-id"
        by_id.mkdir(parents=True, exist_ok=True)
        for index, node in enumerate(self._nodes()):
            (self.root / "dev" / node).touch()
            (by_id / f"usb-{self.spec.serial}-video-index{index}").symlink_to(f"../../{node}")
            device = self.root / "sys/class/video4linux" / node
            (device / "device").mkdir(parents=True, exist_ok=True)
            (device / "serial").write_text(f"{self.spec.serial}\n")
        self._present = True


def _index(data: memoryview) -> int:
    (index,) = struct.unpack_from("I", data)
    return int(index)


# --------------------------------------------------------------------------------------------------
# The buffers of the simulated V4L2 camera, with the order of calls that the kernel insists on.

PAGE_BITS = 12
"""Piece n of the memory is mapped at offset n << PAGE_BITS."""


def refusal(number: int) -> OSError:
    """The error as the kernel refuses."""
    return OSError(number, os.strerror(number))


class Buffers:
    """Memory-mapped buffers: requested, queued, started, filled, queued again."""

    def __init__(self) -> None:
        self.memory: list[npt.NDArray[np.uint8]] = []
        """The pieces of the first buffer, then those of the second."""
        self._pieces = 1
        self._queued: deque[int] = deque()
        self._on = False
        self._lock = threading.Lock()

    def request(self, count: int, sizes: Sequence[int]) -> None:
        """VIDIOC_REQBUFS: ``count`` buffers of pieces of these sizes; EBUSY while streaming."""
        if self._on:
            raise refusal(errno.EBUSY)
        self._pieces = len(sizes)
        self.memory = [np.zeros(size, np.uint8) for _ in range(count) for size in sizes]

    def existing(self, index: int) -> int:
        """``index``, or EINVAL if there is no such buffer."""
        if index * self._pieces >= len(self.memory):
            raise refusal(errno.EINVAL)
        return index

    def queue(self, index: int) -> None:
        """VIDIOC_QBUF: the buffer may be filled."""
        with self._lock:
            if self.existing(index) in self._queued:
                raise refusal(errno.EINVAL)
            self._queued.append(index)

    def start(self) -> None:
        """VIDIOC_STREAMON."""
        if not self._queued:
            raise refusal(errno.EINVAL)
        self._on = True

    def stop(self) -> None:
        """VIDIOC_STREAMOFF: no buffer is queued afterwards."""
        self._on = False
        self._queued.clear()

    def ready(self) -> bool:
        """True if there is a buffer for the next picture; refuses before the start."""
        if not self._on:
            raise refusal(errno.EINVAL)
        return bool(self._queued)

    def fill(self, payloads: Sequence[npt.NDArray[np.uint8]]) -> int:  # each [bytes]
        """The buffer that holds ``payloads`` now, and belongs to the program."""
        with self._lock:
            index = self._queued.popleft()
        for piece, payload in enumerate(payloads, self._pieces * index):
            self.memory[piece][: payload.size] = payload
        return index
