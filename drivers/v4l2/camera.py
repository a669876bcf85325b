"""A V4L2 camera as a live CameraSource."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.capture import RawPicture, no_file, nothing_to_release
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.h264 import Units, decode, units_of
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.v4l2.capture import V4l2Capture
from aquaflow.drivers.v4l2.discovery import explain_error, find_camera
from aquaflow.drivers.v4l2.pixels import STREAMED
from aquaflow.drivers.v4l2.system import Kernel, KernelInterface
from aquaflow.types import CameraModel


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
    def configured(cls, name: str, config: V4l2Config) -> V4l2Camera:
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
