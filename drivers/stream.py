"""A video stream as a live CameraSource, through OpenCV's FFmpeg.

Streams carry no moment of exposure that FFmpeg hands on: pictures are stamped when they arrive,
less the configured latency.
"""

from __future__ import annotations

import os
import threading
import time
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import RawPicture, UnusablePictureError
from aquaflow.drivers.live import LiveCamera
from aquaflow.messages import CameraModel

# OpenCV reads this once, when it first meets a video; -8 is FFmpeg's AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
"""Environment variable from which OpenCV takes the options of FFmpeg."""

OPEN_TIMEOUT_S = 5.0
"""Timeout of a connection: a running camera answers within 1 s, a booting one within this."""

PROBE = "fflags;nobuffer|flags;low_delay|analyzeduration;1000000"
"""FFmpeg options: no buffering, and at most 1 s (in us) to analyse the stream."""

MAX_DAMAGED = 30
"""Pictures in a row that fail to decode before the stream counts as broken: 1 s."""

_opening = threading.Lock()
"""FFmpeg's options go through the environment: one stream opens at a time."""


class StreamCapture:
    """One connection."""

    camera: CameraModel | None = None
    notes: tuple[str, ...] = ()

    def __init__(self, config: StreamConfig) -> None:
        """Connect.

        Raises:
            ConnectionError: no server answers, or its data are no video.
        """
        self._latency_ns = round(config.latency_s * 1e9)
        # A wait that the time limit ended must not be taken for a quick failure.
        self._stall_ns = round(0.9 * config.stall_s * 1e9)
        self._damaged = 0
        self._grabbed = False
        self._capture = _opened(config)
        if not self._capture.isOpened():
            raise ConnectionError(f"no video from {without_password(config.url)}")

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; FFmpeg waits up to the configured stall time."""
        if not self._grabbed:
            self._grab()
        bgr = None
        if self._damaged > 0:
            self._damaged -= 1
        else:
            self._grabbed = False
            decoded, picture = self._capture.retrieve()
            bgr = picture if decoded else None
        arrival_ns = time.monotonic_ns()
        return RawPicture(
            arrival_ns=arrival_ns,
            decode=lambda: _rgb(bgr),
            exposed_ns=arrival_ns - self._latency_ns,
        )

    def close(self) -> None:
        self._capture.release()

    def _grab(self) -> None:
        """FFmpeg reports a damaged picture and the end alike; at the end no picture follows."""
        deadline_ns = time.monotonic_ns() + self._stall_ns
        while not self._capture.grab():
            self._damaged += 1
            if self._damaged > MAX_DAMAGED or time.monotonic_ns() > deadline_ns:
                raise ConnectionError("the stream ended or stalled")
        self._grabbed = True


class StreamCamera(LiveCamera):
    """The newest picture of a stream; connects again whenever it breaks."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        super().__init__(name, config, lambda: StreamCapture(config))

    @classmethod
    def configured(cls, name: str, config: StreamConfig) -> StreamCamera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)


def without_password(url: str) -> str:
    """For logs: cameras are often addressed with their password."""
    parts = urlsplit(url)
    if parts.username is None and parts.password is None:
        return url
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


def _opened(config: StreamConfig) -> Any:
    import cv2

    options = f"rtsp_transport;{config.transport}|{PROBE}"
    if config.url.endswith(".sdp"):
        options += "|protocol_whitelist;file,rtp,udp"
    limits = [
        *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(OPEN_TIMEOUT_S * 1e3)),
        *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(config.stall_s * 1e3)),
    ]
    with _opening:
        before = os.environ.get(OPTIONS)
        # What a stream does wrong is in its state and in the log, not on the terminal.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        os.environ[OPTIONS] = options
        try:
            return cv2.VideoCapture(config.url, cv2.CAP_FFMPEG, limits)
        finally:
            if before is None:
                del os.environ[OPTIONS]
            else:
                os.environ[OPTIONS] = before


def _rgb(
    bgr: npt.NDArray[np.uint8] | None,  # [H, W, 3]
) -> npt.NDArray[np.uint8]:
    import cv2

    if bgr is None:
        raise UnusablePictureError("cannot be decoded")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
