"""One opening of a V4L2 device, memory-mapped and read without a copy; the live camera on it."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.capture import RawPicture, UnusablePictureError, no_file, nothing_to_release
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.h264 import Units, decode, units_of
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.v4l2 import abi
from aquaflow.drivers.v4l2.discovery import capabilities, explain_error, find_camera
from aquaflow.drivers.v4l2.planes import (
    JPEG_PIXELS,
    STREAMED,
    BufferLayout,
    SinglePlanar,
    layout_of,
    to_rgb,
)
from aquaflow.drivers.v4l2.system import Kernel, KernelInterface, call, supports
from aquaflow.types import CameraModel, EncodedPicture


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
        self._layout: BufferLayout = SinglePlanar()
        self._fd = system.open(path)
        self._open = True
        try:
            self._layout = layout_of(capabilities(system, self._fd))
            self.settled = self._layout.negotiate_format(system, self._fd, config)
            fps, rate_notes = self._set_rate(config)
            controls = apply_controls(system, self._fd, config)
            self._maps = [self._map(index) for index in range(self._request(config.buffers))]
            for index in range(len(self._maps)):
                self._queue(index)
            call(system, self._fd, abi.STREAMON, ctypes.c_int32(self._layout.kind))
        except BaseException:
            self.close()
            raise
        self._exposure_s, self._gain = controls.exposure_s, controls.gain
        size = f"{self.settled.width} x {self.settled.height}"
        self.format = f"{size} {self.settled.pixels}, {fps:.3g} pictures/s"
        self.notes = (*self._format_notes(config), *rate_notes, *controls.notes)

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; None when ``timeout_s`` passed without one.

        Raises:
            OSError: the device is gone.
        """
        if not self._system.wait(self._fd, timeout_s):
            return None
        buffer = self._layout.buffer()
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
                call(self._system, self._fd, abi.STREAMOFF, ctypes.c_int32(self._layout.kind))
            self._system.close(self._fd)

    def _picture(self, buffer: abi.Buffer) -> RawPicture:
        monotonic = buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
        stamp_ns = buffer.seconds * 1_000_000_000 + buffer.microseconds * 1_000
        starts = buffer.flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE
        if not starts and self._exposure_s is not None:
            stamp_ns -= round(self._exposure_s * 1e9)
        used = self._layout.picture_slices(buffer)
        data = [place[part] for place, part in zip(self._maps[buffer.index], used, strict=True)]
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
        data: list[npt.NDArray[np.uint8]],  # of each piece of memory [bytes used]
        flags: int,
    ) -> npt.NDArray[np.uint8]:
        if flags & abi.BUF_FLAG_ERROR:
            raise UnusablePictureError("was damaged on its way from the camera")
        return to_rgb(data, self.settled)

    def _file(
        self,
        data: list[npt.NDArray[np.uint8]],  # of each piece of memory [bytes used]
    ) -> EncodedPicture | None:
        if self.settled.pixels in JPEG_PIXELS:
            return EncodedPicture("jpeg", data[0].tobytes())
        return (
            EncodedPicture("h264", data[0].tobytes()) if self.settled.pixels == STREAMED else None
        )

    def _queue(self, index: int) -> None:
        """Give a buffer back to the kernel; nothing if the device is closed or gone."""
        with self._lock:
            if not self._open:
                return
            try:
                call(self._system, self._fd, abi.QBUF, self._layout.buffer(index))
            except OSError as error:
                if error.errno != errno.ENODEV:  # the next read says that it is gone
                    raise

    def _set_rate(self, config: V4l2Config) -> tuple[float, tuple[str, ...]]:
        """Ask; the rate that it is, and for people, where it is another."""
        rate = abi.StreamParameters(type=self._layout.kind)
        rate.timeperframe = abi.Fraction(1000, round(config.fps * 1000))
        if not supports(self._system, self._fd, abi.S_PARM, rate):
            return config.fps, ()
        period = rate.timeperframe
        got = period.denominator / max(1, period.numerator)
        if abs(got - config.fps) < 0.01 * config.fps:
            return got, ()
        return got, (f"the camera gives {got:.3g} pictures/s where {config.fps:g} were asked for",)

    def _format_notes(self, config: V4l2Config) -> tuple[str, ...]:
        got = (self.settled.width, self.settled.height, self.settled.pixels)
        if got == (config.width, config.height, config.pixels):
            return ()
        return (
            f"the camera gives {got[0]} x {got[1]} {got[2]} where {config.width} x "
            f"{config.height} {config.pixels} was asked for",
        )

    def _request(self, count: int) -> int:
        request = abi.RequestBuffers(count, self._layout.kind, abi.MEMORY_MMAP)
        call(self._system, self._fd, abi.REQBUFS, request)
        if request.count < 3:
            raise OSError(errno.ENOMEM, f"the camera has {request.count} buffers, needs 3", None)
        return int(request.count)

    def _map(self, index: int) -> list[npt.NDArray[np.uint8]]:
        buffer = self._layout.buffer(index)
        call(self._system, self._fd, abi.QUERYBUF, buffer)
        places = self._layout.places(buffer)
        return [self._system.mmap(self._fd, length, offset) for length, offset in places]


# --------------------------------------------------------------------------------------------------
# Exposure, gain and white balance; what a camera lacks is a note, not an error.


@dataclass(frozen=True)
class FixedControls:
    """What the camera confirmed; None where it decides for itself."""

    exposure_s: float | None
    gain: float | None
    notes: tuple[str, ...]


def apply_controls(system: KernelInterface, fd: int, config: V4l2Config) -> FixedControls:
    """Set what ``config`` fixes and read it back.

    Raises:
        OSError: the device is gone.
    """
    notes: list[str] = []

    def fix(what: str, automatic: tuple[int, int], control: int, wanted: int) -> int | None:
        # A camera without the automatic may still have the value, so its absence says nothing.
        supports(system, fd, abi.S_CTRL, abi.V4l2Control(*automatic))
        value = _set(system, fd, control, wanted)
        if value is None:
            notes.append(f"the camera has no fixed {what}; it decides for itself")
        return value

    exposure = gain = None
    if config.exposure_s is not None:
        exposure = fix(
            "exposure",
            (abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL),
            abi.CID_EXPOSURE_ABSOLUTE,
            max(1, round(config.exposure_s / abi.EXPOSURE_UNIT_S)),
        )
    if config.gain is not None:
        gain = fix("gain", (abi.CID_AUTOGAIN, 0), abi.CID_GAIN, config.gain)
    if config.white_balance_k is not None:
        fix(
            "white balance",
            (abi.CID_AUTO_WHITE_BALANCE, 0),
            abi.CID_WHITE_BALANCE_TEMPERATURE,
            config.white_balance_k,
        )
    exposure_s = None if exposure is None else exposure * abi.EXPOSURE_UNIT_S
    return FixedControls(exposure_s, None if gain is None else float(gain), tuple(notes))


def _set(system: KernelInterface, fd: int, control: int, wanted: int) -> int | None:
    """Set within the camera's range; what it then has, None if it has no such control."""
    limits = abi.QueryControl(id=control)
    if not supports(system, fd, abi.QUERYCTRL, limits):
        return None
    setting = abi.V4l2Control(control, max(limits.minimum, min(limits.maximum, wanted)))
    if not supports(system, fd, abi.S_CTRL, setting):
        return None
    call(system, fd, abi.G_CTRL, setting)
    return int(setting.value)


# --------------------------------------------------------------------------------------------------
# A V4L2 camera as a live CameraSource.


class V4l2Camera(LiveCamera):
    """The camera with the id in its config, wherever it is plugged in this time."""

    def __init__(
        self,
        name: str,
        config: V4l2Config,
        system: KernelInterface | None = None,
        root: Path = Path("/"),
    ) -> None:
        self._system = system or Kernel()
        self._root = root
        self._v4l2 = config
        super().__init__(name, config, self._open_device)

    @classmethod
    def from_config(cls, name: str, config: V4l2Config) -> V4l2Camera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)

    def _open_device(self) -> V4l2Capture | StreamedCapture:
        node = find_camera(self._system, self._v4l2.device, self._root)
        try:
            capture = V4l2Capture(self._system, str(node.path), self._v4l2)
        except OSError as error:
            raise explain_error(error, node.path) from error
        if capture.settled.pixels != STREAMED:
            return capture
        return StreamedCapture(capture, self._v4l2.stall_s)


# --------------------------------------------------------------------------------------------------
# A V4L2 camera that sends H.264: every picture is decoded, since the next ones need it.

WAIT_S = 0.2
"""Longest wait for one buffer."""


class StreamedCapture:
    """Decodes what another capture takes from the device, whose buffers go back at once."""

    camera: CameraModel | None = None

    def __init__(self, device: V4l2Capture, stall_s: float) -> None:
        self.notes, self.format = device.notes, device.format
        self._device, self._stall_s = device, stall_s
        self._pictures = decode(self._receive_pictures())

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; waits up to the configured stall time for it.

        Raises:
            OSError: the device is gone, or silent.
        """
        taken, bgr = next(self._pictures)
        return replace(taken, decode=rgb_of(bgr), received=no_file, release=nothing_to_release)

    def close(self) -> None:
        self._pictures.close()
        self._device.close()

    def _receive_pictures(self) -> Iterator[tuple[RawPicture, Units]]:
        """What the device sends, in memory of its own."""
        heard_s = time.monotonic()
        while True:
            picture = self._device.read(WAIT_S)
            if picture is not None:
                file = picture.received()
                picture.release()
                heard_s = time.monotonic()
                yield picture, [] if file is None else units_of(file.data)
            elif time.monotonic() - heard_s > self._stall_s:
                raise TimeoutError(f"no picture for {self._stall_s:g} s")
