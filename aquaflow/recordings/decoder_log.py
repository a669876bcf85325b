"""What OpenCV's FFmpeg complains about while it decodes: it returns such pictures as good ones.

The log is listened to through FFmpeg's public ``av_log_set_callback``. The callback needs Python's
lock, so a capture is released while the log is still entered, never left to the garbage collector.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

# OpenCV reads this once, when it first meets a video; -8 is FFmpeg's AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

ERROR = 16
"""FFmpeg's AV_LOG_ERROR: a picture, or a part of it, that could not be decoded."""
HARMLESS = (b"Unsupported codec with id",)
"""Of streams beside the picture, such as a GoPro's sensors."""
LONGEST_LINE = 512
"""Bytes; the rest of a longer complaint is cut off."""

_CALLBACK = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p)


class DecoderLog:
    """The errors of the FFmpeg in this process while it is entered; several readers share them."""

    _lock = threading.Lock()
    _listeners: list[DecoderLog] = []  # noqa: RUF012
    _callback: Any = None

    def __init__(self) -> None:
        self._complaints: list[str] = []

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

    def complaints(self) -> list[str]:
        """Errors since the last call, a line each."""
        new, self._complaints = self._complaints, []
        return new


def _heard(part: int | None, level: int, text: bytes | None, values: int | None) -> None:
    """In a thread of FFmpeg: ``text`` is a format, ``values`` its va_list."""
    library = _libavutil()
    if library is None or level > ERROR or text is None or text.startswith(HARMLESS):
        return
    line, prefix = ctypes.create_string_buffer(LONGEST_LINE), ctypes.c_int(0)
    library.av_log_format_line2(
        ctypes.c_void_p(part), level, text, ctypes.c_void_p(values),
        line, LONGEST_LINE, ctypes.byref(prefix),
    )  # fmt: skip
    said = line.value.decode("utf-8", "replace").strip()
    for each in tuple(DecoderLog._listeners):
        each._complaints.append(said)


@lru_cache(maxsize=1)
def _libavutil() -> Any | None:
    """The library that OpenCV has loaded; None where its FFmpeg cannot be reached."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/maps").read_text().splitlines():
            path = line.partition("/")[2]
            if "libavutil" in path.rpartition("/")[2]:
                return ctypes.CDLL(f"/{path}")
    return None
