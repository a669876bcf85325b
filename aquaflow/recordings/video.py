"""A video file as a camera."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError, printable
from aquaflow.geometry.camera import ASPECT_TOLERANCE, guess_camera, load_camera
from aquaflow.recordings.images import CALIBRATION, DEFAULT_FPS, NS_PER_S
from aquaflow.sources import is_asked
from aquaflow.types import CameraModel, Dropped, Frame

# OpenCV reads this once, when it first meets a video; -8 is FFmpeg's AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

EXTENSIONS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".ts"})
"""Of files in containers that FFmpeg reads and cameras write."""

COUNT_TOLERANCE = 1
"""Some containers give a duration instead of a count; one frame less is not a cut-off video."""


class VideoFile:
    """Frames of a video with the times of its container.

    Frames that are not asked for are only grabbed: decoded as far as the codec needs, never
    converted, which makes ``every`` cheap.
    """

    specificity = 1

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Open the video and decode its first frame.

        Raises:
            InputError: the file is not a video, or no frame of it can be decoded.
            ConfigError: the ``camera.yaml`` next to it is malformed.
        """
        self.path = path
        self.notes: list[str] = []
        with _open_capture(path) as capture:
            import cv2

            if not capture.isOpened() or not capture.grab():
                raise InputError(
                    f"{path} cannot be read as a video; check that it plays, or give a folder of "
                    "images"
                )
            self.width = int(_property(capture, cv2.CAP_PROP_FRAME_WIDTH))
            self.height = int(_property(capture, cv2.CAP_PROP_FRAME_HEIGHT))
            count = int(_property(capture, cv2.CAP_PROP_FRAME_COUNT))
            rate = _property(capture, cv2.CAP_PROP_FPS)
        self.frame_count: int | None = count if count > 0 else None
        known = rate if rate > 0.0 else DEFAULT_FPS
        self._period_ns = NS_PER_S / (known if fps is None else fps)
        self.camera = self._sidecar_calibration()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in EXTENSIONS

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> VideoFile:
        return cls(path, fps)

    def name_of(self, index: int) -> str:
        """The video's name and the frame's number, ``clip.mp4#12``."""
        return f"{printable(self.path.name)}#{index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The frames ``start, start + every, ...`` below ``stop``; always read from the beginning.

        Seeking is left out on purpose: it is inexact in many containers, and times would differ
        from those of a full pass.
        """
        self.notes = [note for note in self.notes if note == self._calibration_note]
        with _open_capture(self.path) as capture:
            clock = _Clock(self._period_ns)
            index = 0
            while stop is None or index < stop:
                if not capture.grab():
                    self._note_early_end(index)
                    break
                t_ns = clock.tick(_position_ms(capture))
                if is_asked(index, every, start):
                    yield self._frame(capture, index, t_ns)
                index += 1
            if clock.repaired:
                self.notes.append(
                    f"{clock.repaired} frame times of {self.path.name} do not increase; they were "
                    "set from the frame rate"
                )

    def close(self) -> None:
        """Nothing stays open between passes."""

    def _frame(self, capture: Any, index: int, t_ns: int) -> Frame | Dropped:
        import cv2

        decoded, bgr = capture.retrieve()
        if not decoded:
            return Dropped(index, t_ns, f"{self.name_of(index)} cannot be decoded")
        image = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        camera = self.camera or guess_camera(image.shape[1], image.shape[0])
        return Frame(index, t_ns, t_ns, image, camera)

    def _note_early_end(self, read: int) -> None:
        if self.frame_count is not None and read < self.frame_count - COUNT_TOLERANCE:
            self.notes.append(f"the video ends after {read} of {self.frame_count} frames")

    def _sidecar_calibration(self) -> CameraModel | None:
        """The ``camera.yaml`` in the video's folder, if it is for pictures of this shape."""
        self._calibration_note = f"the calibration is {self.path.parent / CALIBRATION}"
        file = self.path.parent / CALIBRATION
        if not file.is_file():
            return None
        camera = load_camera(file)
        aspect = camera.width / camera.height * self.height / self.width
        if abs(aspect - 1.0) > ASPECT_TOLERANCE:
            return None
        self.notes.append(self._calibration_note)
        return camera


class _Clock:
    """Times since the first frame that strictly increase, whatever the container says."""

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._first_ms: float | None = None
        self._last_ns = -1
        self.repaired = 0
        """Times that did not increase and were set from the frame rate."""

    def tick(self, position_ms: float) -> int:
        """Nanoseconds since the first frame, for a frame that the container puts at a time."""
        if self._first_ms is None:
            self._first_ms = position_ms
            self._last_ns = 0
            return 0
        t_ns = round((position_ms - self._first_ms) * 1e6)
        if t_ns <= self._last_ns:
            t_ns = self._last_ns + round(self._period_ns)
            self.repaired += 1
        self._last_ns = t_ns
        return t_ns


@contextlib.contextmanager
def _open_capture(path: Path) -> Iterator[Any]:
    """A capture on ``path`` that says nothing on stderr: what goes wrong is in the notes."""
    import cv2

    # Software decoding: hardware decoders differ between machines in the last bit.
    software = [cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE]
    loud = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, software)
    finally:
        cv2.utils.logging.setLogLevel(loud)
    try:
        yield capture
    finally:
        capture.release()


def _position_ms(capture: Any) -> float:
    """The grabbed frame's time in its container."""
    import cv2

    return _property(capture, cv2.CAP_PROP_POS_MSEC)


def _property(capture: Any, number: int) -> float:
    """What a container says of itself; zero, as unknown, where that is not finite."""
    value = float(capture.get(number))
    return value if np.isfinite(value) else 0.0
