"""OpenCV's FFmpeg with options of ours; other openings of this process keep theirs."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.drivers.capture import UnusablePictureError

# OpenCV reads this once, when it first meets a video; -8 is FFmpeg's AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
"""Environment variable from which OpenCV takes the options of FFmpeg."""

DECODER_THREADS = 1
"""FFmpeg's other threads decode other pictures, and each holds one back: on two cores, RTSP of
1280x720 at 30 pictures/s came 69 ms after it was sent, with one thread 39 ms."""

_opening = threading.Lock()
"""FFmpeg's options go through the environment: one video opens at a time."""


def video_capture(
    source: str | io.BufferedIOBase,
    options: Mapping[str, str],
    limits: Sequence[int] = (),
) -> Any:
    """A ``cv2.VideoCapture`` that decodes in one thread, and may not be open.

    ``limits`` are OpenCV's own properties, each followed by its value.
    """
    import cv2

    properties = [
        *limits,
        *(cv2.CAP_PROP_N_THREADS, DECODER_THREADS),
        *(cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE),
    ]
    opened: Any = source  # OpenCV's stubs know only its own class of streams
    with _opening:
        before = os.environ.get(OPTIONS)
        # What a stream does wrong is in its state and in the log, not on the terminal.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        os.environ[OPTIONS] = "|".join(f"{key};{value}" for key, value in options.items())
        try:
            return cv2.VideoCapture(opened, cv2.CAP_FFMPEG, properties)
        finally:
            if before is None:
                del os.environ[OPTIONS]
            else:
                os.environ[OPTIONS] = before


def rgb_of(
    bgr: npt.NDArray[np.uint8] | None,  # [H, W, 3]
    otherwise: str = "cannot be decoded",
) -> Callable[[], npt.NDArray[np.uint8]]:
    """What turns FFmpeg's picture into ours, once it is used; None makes none, for a reason."""

    def convert() -> npt.NDArray[np.uint8]:
        import cv2

        if bgr is None:
            raise UnusablePictureError(otherwise)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)

    return convert
