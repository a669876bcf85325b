"""A video stream that FFmpeg reads: RTSP, HTTP, MPEG-TS, and RTP of other codecs than H.264."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import RawPicture
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.jpeg import jpeg_to_rgb
from aquaflow.drivers.stream.address import for_logs, is_at_a_port
from aquaflow.drivers.stream.ages import Ages
from aquaflow.drivers.stream.ffmpeg import OPEN_TIMEOUT_S, format_of, open_capture
from aquaflow.types import CameraModel, EncodedPicture

MOTION_JPEG = "MJPG"
"""FFmpeg's name of a stream whose pictures are JPEG files."""
MAX_DAMAGED = 30
"""Pictures in a row that fail to decode before the stream counts as broken: 1 s."""


class StreamCapture:
    """One connection."""

    camera: CameraModel | None = None
    notes: tuple[str, ...] = ()

    def __init__(self, name: str, config: StreamConfig, source: str) -> None:
        """Connect to ``source``, which FFmpeg can open.

        Raises:
            ConnectionError: no server answers, or its data are no video.
        """
        self._stall_ns = round(config.stall_s * 1e9)
        # The first picture comes with a key frame, which may be seconds away.
        self._patience_ns = max(self._stall_ns, round(OPEN_TIMEOUT_S * 1e9))
        self._ages = Ages(name, config)
        self._stale = ""
        self._damaged = 0
        self._grabbed = False
        self._capture = open_capture(source, config)
        if not self._capture.isOpened() or not self._has_size():
            self.close()
            raise ConnectionError(f"no video from {for_logs(config.url)}{_advice(config)}")
        self.format = format_of(self._capture)
        self._width, self._height = _size(self._capture)
        self._sends_jpeg = self.format.endswith(f" {MOTION_JPEG}") and _hands_over(self._capture)

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; FFmpeg waits up to the configured stall time."""
        if not self._grabbed:
            self._grab()
        arrival_ns = time.monotonic_ns()
        if self._damaged > 0:
            self._damaged -= 1
            return RawPicture(arrival_ns, rgb_of(None), stale=self._stale)
        self._grabbed = False
        exposed_ns, self._stale = self._ages.judge(self._stream_ns(), arrival_ns)
        shown = None if self._stale else self._retrieve()
        if shown is None or not self._sends_jpeg:
            return RawPicture(arrival_ns, rgb_of(shown), exposed_ns, stale=self._stale)
        jpeg = shown.reshape(-1)
        return RawPicture(
            arrival_ns,
            partial(jpeg_to_rgb, jpeg, self._width, self._height),
            exposed_ns,
            received=lambda: EncodedPicture("jpeg", jpeg.tobytes()),
        )

    def close(self) -> None:
        self._capture.release()

    def _has_size(self) -> bool:
        import cv2

        return bool(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH) > 0.0)

    def _grab(self) -> None:
        """FFmpeg reports a damaged picture and the end alike; at the end no picture follows."""
        deadline_ns = time.monotonic_ns() + self._patience_ns
        since_ns = time.monotonic_ns()
        while not self._capture.grab():
            before_ns, since_ns = since_ns, time.monotonic_ns()
            # A wait that the time limit ended is no damaged picture.
            self._damaged += since_ns - before_ns < 0.9 * self._stall_ns
            if self._damaged > MAX_DAMAGED or since_ns > deadline_ns:
                raise ConnectionError("the stream ended or stalled")
        self._grabbed = True
        self._patience_ns = round(0.9 * self._stall_ns)

    def _stream_ns(self) -> int:
        """The stream's own time of the grabbed picture."""
        import cv2

        return round(1e6 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC)))

    def _retrieve(self) -> npt.NDArray[np.uint8] | None:
        """[H, W, 3] BGR, or the bytes of a JPEG file; must be fetched before the next picture is
        grabbed, used or not."""
        decoded, bgr = self._capture.retrieve()
        return bgr if decoded else None


def _size(capture: Any) -> tuple[int, int]:
    """Width and height, px."""
    import cv2

    width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    return int(capture.get(width)), int(capture.get(height))


def _hands_over(capture: Any) -> bool:
    """Let FFmpeg pass on the pictures' files as they came; False if it cannot."""
    import cv2

    return bool(capture.set(cv2.CAP_PROP_FORMAT, -1))


def _advice(config: StreamConfig) -> str:
    """What may be wrong where packets come, but no picture."""
    if not is_at_a_port(config.url):
        return ""
    return (
        f" within {OPEN_TIMEOUT_S:g} s, though packets come; is its codec {config.codec}, and does "
        f"it send key frames?"
    )
