"""One opening of a V4L2 device: memory-mapped buffers, read without a copy."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.capture import RawPicture, UnusablePictureError
from aquaflow.drivers.v4l2 import abi
from aquaflow.drivers.v4l2.controls import apply_controls
from aquaflow.drivers.v4l2.pixels import JPEG_PIXELS, to_rgb
from aquaflow.drivers.v4l2.system import KernelInterface, call, supported
from aquaflow.messages import CameraModel, EncodedPicture


class V4l2Capture:
    """A streaming device. Pictures are views of the kernel's buffers until they are released."""

    camera: CameraModel | None = None

    def __init__(
        self,
        system: KernelInterface,
        path: str,
        config: V4l2Config,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Open ``path`` and start streaming.

        Raises:
            OSError: the device is gone, in use by another process, or takes no pictures.
        """
        self._system = system
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._fd = system.open(path)
        self._open = True
        try:
            self._set_format(config)
            controls = apply_controls(system, self._fd, config)
            self._maps = [self._map(index) for index in range(self._request(config.buffers))]
            for index in range(len(self._maps)):
                self._queue(index)
            call(system, self._fd, abi.STREAMON, ctypes.c_int32(abi.VIDEO_CAPTURE))
        except BaseException:
            self.close()
            raise
        self._exposure_s, self._gain = controls.exposure_s, controls.gain
        self.notes = (*self._format_notes(config), *controls.notes)

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; None when ``timeout_s`` passed without one.

        Raises:
            OSError: the device is gone.
        """
        if not self._system.wait(self._fd, timeout_s):
            return None
        buffer = abi.Buffer(type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        try:
            call(self._system, self._fd, abi.DQBUF, buffer)
        except BlockingIOError:
            return None
        return self._picture(buffer)

    def close(self) -> None:
        """Give the device back; the memory of pictures not yet released stays until they are."""
        with self._lock:
            was_open, self._open = self._open, False
            self._maps = []
        if was_open:
            # An unplugged device has stopped already.
            with contextlib.suppress(OSError):
                call(self._system, self._fd, abi.STREAMOFF, ctypes.c_int32(abi.VIDEO_CAPTURE))
            self._system.close(self._fd)

    def _picture(self, buffer: abi.Buffer) -> RawPicture:
        monotonic = buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
        stamp_ns = buffer.seconds * 1_000_000_000 + buffer.microseconds * 1_000
        starts = buffer.flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE
        if not starts and self._exposure_s is not None:
            stamp_ns -= round(self._exposure_s * 1e9)
        data = self._maps[buffer.index][: buffer.bytesused]
        return RawPicture(
            arrival_ns=self._now_ns(),
            decode=partial(self._decode, data, int(buffer.flags)),
            exposed_ns=stamp_ns if monotonic else None,
            sequence=int(buffer.sequence),
            exposure_s=self._exposure_s,
            gain=self._gain,
            received=partial(self._file, data),
            release=partial(self._queue, int(buffer.index)),
        )

    def _decode(
        self,
        data: npt.NDArray[np.uint8],  # [bytes used]
        flags: int,
    ) -> npt.NDArray[np.uint8]:
        if flags & abi.BUF_FLAG_ERROR:
            raise UnusablePictureError("was damaged on its way from the camera")
        pix = self._pix
        return to_rgb(data, self.pixels, pix.width, pix.height, pix.bytesperline)

    def _file(
        self,
        data: npt.NDArray[np.uint8],  # [bytes used]
    ) -> EncodedPicture | None:
        return EncodedPicture("jpeg", data.tobytes()) if self.pixels in JPEG_PIXELS else None

    def _queue(self, index: int) -> None:
        """Give a buffer back to the kernel; nothing if the device is closed or gone."""
        with self._lock:
            if not self._open:
                return
            buffer = abi.Buffer(index=index, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
            try:
                call(self._system, self._fd, abi.QBUF, buffer)
            except OSError as error:
                if error.errno != errno.ENODEV:  # the next read says that it is gone
                    raise

    def _set_format(self, config: V4l2Config) -> None:
        """Ask, and take what the driver makes of it: it changes sizes and formats as it likes."""
        wanted = abi.Format(type=abi.VIDEO_CAPTURE)
        wanted.fmt.pix.width, wanted.fmt.pix.height = config.width, config.height
        wanted.fmt.pix.pixelformat = abi.fourcc(config.pixels)
        call(self._system, self._fd, abi.S_FMT, wanted)
        self._pix = wanted.fmt.pix
        self.pixels = int(self._pix.pixelformat).to_bytes(4, "little").decode("ascii", "replace")
        rate = abi.StreamParameters(type=abi.VIDEO_CAPTURE)
        rate.timeperframe = abi.Fraction(1000, round(config.fps * 1000))
        supported(self._system, self._fd, abi.S_PARM, rate)
        self.fps = rate.timeperframe.denominator / max(1, rate.timeperframe.numerator)

    def _format_notes(self, config: V4l2Config) -> tuple[str, ...]:
        got = (int(self._pix.width), int(self._pix.height), self.pixels)
        if got == (config.width, config.height, config.pixels):
            return ()
        return (
            f"the camera gives {got[0]} x {got[1]} {got[2]} where {config.width} x "
            f"{config.height} {config.pixels} was asked for",
        )

    def _request(self, count: int) -> int:
        request = abi.RequestBuffers(count=count, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        call(self._system, self._fd, abi.REQBUFS, request)
        if request.count < 3:
            raise OSError(errno.ENOMEM, f"the camera has {request.count} buffers, needs 3", None)
        return int(request.count)

    def _map(self, index: int) -> npt.NDArray[np.uint8]:
        buffer = abi.Buffer(index=index, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        call(self._system, self._fd, abi.QUERYBUF, buffer)
        return self._system.mmap(self._fd, buffer.length, buffer.offset & 0xFFFFFFFF)
