"""A V4L2 camera that sends H.264: every picture is decoded, since the next ones need it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from aquaflow.drivers.capture import RawPicture, no_file, nothing_to_release
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.h264 import Units, decoded, units_of
from aquaflow.drivers.v4l2.capture import V4l2Capture
from aquaflow.types import CameraModel

WAIT_S = 0.2
"""Longest wait for one buffer."""


class StreamedCapture:
    """Decodes what another capture takes from the device, whose buffers go back at once."""

    camera: CameraModel | None = None

    def __init__(self, device: V4l2Capture, stall_s: float) -> None:
        self.notes, self.format = device.notes, device.format
        self._device, self._stall_s = device, stall_s
        self._pictures = decoded(self._received())

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

    def _received(self) -> Iterator[tuple[RawPicture, Units]]:
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
