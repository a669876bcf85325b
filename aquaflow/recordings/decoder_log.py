"""What OpenCV's FFmpeg complains about, and FFmpeg's own program where OpenCV cannot convert.

OpenCV returns True for pictures that its scaler refused: their memory holds whatever was there
before. Only FFmpeg's log tells, so it is listened to, through its public ``av_log_set_callback``.
"""

from __future__ import annotations

import contextlib
import ctypes
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError

ERROR = 16
"""FFmpeg's AV_LOG_ERROR: a picture, or a part of it, that could not be decoded."""
HARMLESS = (b"Unsupported codec with id",)
"""Of streams beside the picture, such as a GoPro's sensors."""

SCALER = b"%s (%s): fmt:"
"""How the scaler's refusals begin (swscale, graph.c); all other errors are of decoders."""

_CALLBACK = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p)


class DecoderLog:
    """Counts the errors of the FFmpeg in this process while it is entered."""

    _lock = threading.Lock()
    _listeners: list[DecoderLog] = []  # noqa: RUF012
    _callback: Any = None

    def __init__(self) -> None:
        self._errors = 0
        self._refused = False

    def __enter__(self) -> DecoderLog:
        with self._lock:
            library = _libavutil()
            if library is not None and DecoderLog._callback is None:
                DecoderLog._callback = _CALLBACK(_heard)
            if library is not None:
                library.av_log_set_callback(DecoderLog._callback)
            self._listeners.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._listeners.remove(self)
            library = _libavutil()
            if library is not None and not self._listeners:
                silent = ctypes.cast(library.av_log_default_callback, ctypes.c_void_p)
                library.av_log_set_callback(silent)

    def refused(self) -> bool:
        """True if the scaler refused a picture since the last call: its memory holds another's."""
        refused, self._refused = self._refused, False
        return refused

    def errors(self) -> int:
        """Errors of decoders since the last call."""
        count, self._errors = self._errors, 0
        return count


def _heard(_: int | None, level: int, text: bytes | None, __: int | None) -> None:
    """In a thread of FFmpeg."""
    if level <= ERROR and text is not None and not text.startswith(HARMLESS):
        for each in tuple(DecoderLog._listeners):
            each._refused |= text.startswith(SCALER)
            each._errors += not text.startswith(SCALER)


def _libavutil() -> Any | None:
    """The library that OpenCV has loaded; None where its FFmpeg cannot be reached."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/maps").read_text().splitlines():
            path = line.partition("/")[2]
            if "libavutil" in path.rpartition("/")[2]:
                return ctypes.CDLL(f"/{path}")
    return None


class FfmpegPictures:
    """Every picture of a video through FFmpeg's program, in order; interlaced ones deinterlaced.

    The filter is bwdif (Weston 3-field and yadif): flagged pictures only, one picture for each, at
    the moment of the first field; progressive pictures pass unchanged.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        """Start FFmpeg; pictures have ``width`` x ``height``.

        Raises:
            InputError: there is no program of that name.
        """
        program = shutil.which("ffmpeg")
        if program is None:
            raise InputError(
                f"{path} has interlaced pictures, which OpenCV cannot convert; install FFmpeg "
                "(apt-get install ffmpeg) and try again"
            )
        filters = f"bwdif=mode=send_frame:deint=interlaced,scale={width}:{height}"
        self._shape = (height, width, 3)
        self._process = subprocess.Popen(
            [
                program, "-nostdin", "-loglevel", "quiet", "-i", f"file:{path.absolute()}",
                "-map", "0:v:0", "-vf", filters, "-fps_mode", "passthrough",
                "-pix_fmt", "rgb24", "-f", "rawvideo", "pipe:1",
            ],
            stdout=subprocess.PIPE,
        )  # fmt: skip
        self._next = 0

    def at(self, index: int) -> npt.NDArray[np.uint8] | None:
        """The picture [H, W, 3] RGB of an index above the last one; None past the end."""
        assert self._process.stdout is not None
        size = int(np.prod(self._shape))
        while True:
            data = self._process.stdout.read(size)
            if len(data) < size:
                return None
            self._next += 1
            if self._next > index:
                return np.frombuffer(data, np.uint8).reshape(self._shape)

    def close(self) -> None:
        """End the program."""
        self._process.kill()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.wait()
