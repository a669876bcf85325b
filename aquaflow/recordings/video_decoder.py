"""A video through OpenCV, whose word is not believed: it returns pictures that FFmpeg refused."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from aquaflow.base.errors import InputError, printable
from aquaflow.recordings.picture import UnreadablePictureError

REFUSED = "Cannot convert interlaced to progressive"
"""FFmpeg's scaler to OpenCV, which then returns the picture before as this one."""
REORDERED = 2
"""Pictures that a codec shows before one that it decoded earlier: H.264 of cameras has 0 to 2."""
LONGEST_DOUBT = 60
"""Pictures: cameras send a whole one every 1 to 2 s, or renew all parts in that time."""
PREDICTED = frozenset({ord("P"), ord("B")})
"""Types of pictures that are made from others."""
FFMPEG = "ffmpeg"
DEINTERLACE = "idet=prog_thres=1.05:intl_thres=1.04,bwdif=mode=send_frame:deint=interlaced"
"""What only says that it is interlaced stays as it is; what is gets one picture a frame.

By idet's usual threshold of 1.5, slow video whose fields are of one moment is undetermined."""
MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
"""What an MP4 begins with (ISO 14496-12, and QuickTime before it)."""
LARGEST_INDEX = 1 << 26
"""Bytes; that of ten hours has as many."""
LEAST_PIXEL, MOST_PIXEL = 0.25, 4.0
"""Width of a pixel in its heights; anamorphic video has 0.75 to 2, anything beyond is damage."""


class VideoDecoder:
    """Pictures in order, each after :meth:`grab`; silent on stderr.

    A picture that the decoder complained about is none. A codec shows pictures in another order
    than it decodes, so the ``REORDERED`` pictures after a complaint are none either, nor are those
    predicted from them, up to the next whole one. Interlaced pictures, which OpenCV cannot convert,
    come from the program ``ffmpeg``, where it is installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.complaint = ""
        """The first one."""
        self.deinterlaced_from: int | None = None
        """The first picture that OpenCV could not convert."""
        self._index, self._doubtful_until, self._doubted_from = -1, -1, 0
        self._reason = ""
        self._ffmpeg: subprocess.Popen[bytes] | None = None
        self._from_ffmpeg = 0
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Open the video.

        Raises:
            InputError: the file is not a video, or no frame of it can be decoded.
        """
        import cv2

        self._capture = _open_capture(self.path)
        self._log = self._stack.enter_context(DecoderLog())
        try:
            if not self._capture.isOpened() or not self._capture.grab():
                if read_index(self.path) == b"":
                    raise InputError(
                        f"{self.path} has no index: it was cut off before the camera wrote one; "
                        "copy it again, or repair it with the camera or a program such as untrunc"
                    )
                said = "".join(f": {complaint}" for complaint in self._log.complaints()[:1])
                raise InputError(
                    f"{self.path} cannot be read as a video{printable(said)}; check that it plays, "
                    "convert it to H.264, or give a folder of images"
                )
            self.width = int(self._property(cv2.CAP_PROP_FRAME_WIDTH))
            self.height = int(self._property(cv2.CAP_PROP_FRAME_HEIGHT))
            self.frame_count = max(0, int(self._property(cv2.CAP_PROP_FRAME_COUNT)))
            self.rate = self._property(cv2.CAP_PROP_FPS)
            self.pixel_width = self._pixel_width()
        except InputError:
            self.__exit__()
            raise
        self._one_thread = False
        self._pending = True
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()
        if self._ffmpeg is not None:
            self._ffmpeg.kill()
            self._ffmpeg.communicate()
        self._stack.close()

    @property
    def position_ms(self) -> float:
        """The grabbed picture's time in its container."""
        import cv2

        return self._property(cv2.CAP_PROP_POS_MSEC)

    def grab(self) -> bool:
        """Decode the next picture; False at the end."""
        grabbed = self._pending or bool(self._capture.grab())
        self._pending = False
        complaints = self._log.complaints()
        if grabbed and complaints and not self._one_thread:
            # Threads decode ahead, so that a complaint belongs to a later picture.
            complaints = self._decode_in_one_thread(self._index + 1)
        self._index += 1
        if grabbed and complaints:
            self._doubt(complaints)
        elif grabbed and self._is_predicted_from_damage():
            self._doubtful_until = self._index
        return grabbed

    def picture(self) -> npt.NDArray[np.uint8]:
        """The grabbed picture, [height, width, 3] BGR.

        Raises:
            UnreadablePictureError: it cannot be decoded, or the decoder complained about it.
        """
        if self._index <= self._doubtful_until:
            raise UnreadablePictureError(f"is damaged: {self._reason}")
        if self.deinterlaced_from is None:
            decoded, bgr = self._capture.retrieve()
            complaints = self._log.complaints()
            if decoded and not complaints:
                return np.asarray(bgr, np.uint8)
            if not any(REFUSED in complaint for complaint in complaints):
                return self._picture_again(complaints)
            self.deinterlaced_from = self._index
        return self._read_deinterlaced()

    def _picture_again(self, complaints: list[str]) -> npt.NDArray[np.uint8]:
        """By one thread, as others decode ahead and may have complained about a later picture."""
        if not self._one_thread:
            complaints = self._decode_in_one_thread(self._index)
            if complaints:
                self._doubt(complaints)
            return self.picture()
        self.complaint = self.complaint or "; ".join(complaints[:1])
        raise UnreadablePictureError("cannot be decoded")

    def _is_predicted_from_damage(self) -> bool:
        import cv2

        if not 0 <= self._index - 1 == self._doubtful_until < self._doubted_from + LONGEST_DOUBT:
            return False
        return int(self._property(cv2.CAP_PROP_FRAME_TYPE)) in PREDICTED

    def _doubt(self, complaints: Sequence[str]) -> None:
        if self._index > self._doubtful_until:
            self._doubted_from = self._index
        self._doubtful_until = self._index + REORDERED
        self._reason = complaints[-1]
        self.complaint = self.complaint or complaints[0]

    def _decode_in_one_thread(self, index: int) -> list[str]:
        """Open again, and decode up to a picture; the complaints about it."""
        self._capture.release()
        self._capture = _open_capture(self.path, threads=1)
        self._one_thread = True
        for _ in range(index):
            self._capture.grab()
        self._log.complaints()
        self._capture.grab()
        return self._log.complaints()

    def _read_deinterlaced(self) -> npt.NDArray[np.uint8]:
        if self._ffmpeg is None:
            program = shutil.which(FFMPEG)
            if program is None:
                raise UnreadablePictureError(
                    "is interlaced, which OpenCV does not decode; install FFmpeg (apt install "
                    "ffmpeg)"
                )
            self._ffmpeg = subprocess.Popen(
                [
                    *(program, "-nostdin", "-v", "quiet", "-i", f"file:{self.path.absolute()}"),
                    *("-map", "0:v:0", "-vf", f"{DEINTERLACE},scale={self.width}:{self.height}"),
                    *("-fps_mode", "passthrough", "-pix_fmt", "bgr24", "-f", "rawvideo", "-"),
                ],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        assert self._ffmpeg.stdout is not None
        size, data = self.width * self.height * 3, b""
        while self._from_ffmpeg <= self._index:
            data = self._ffmpeg.stdout.read(size)
            self._from_ffmpeg += 1
        if len(data) != size:
            raise UnreadablePictureError("is interlaced, and FFmpeg does not decode it")
        return np.frombuffer(data, np.uint8).reshape(self.height, self.width, 3)

    def _pixel_width(self) -> float:
        """Of a pixel, in its heights."""
        import cv2

        wide, high = (
            self._property(number) for number in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN)
        )
        if wide <= 0.0 or high <= 0.0:
            return 1.0
        turned = self._property(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90
        ratio = high / wide if turned else wide / high
        return ratio if LEAST_PIXEL <= ratio <= MOST_PIXEL else 1.0

    def _property(self, number: int) -> float:
        """What a container says of itself; zero, as unknown, where that is not finite."""
        value = float(self._capture.get(number))
        return value if np.isfinite(value) else 0.0


def _open_capture(path: Path, threads: int | None = None) -> Any:
    """A capture on ``path``; a relative path with a colon would be a protocol to FFmpeg."""
    import cv2

    # Software decoding: hardware decoders differ between machines in the last bit.
    options = [cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE]
    if threads is not None:
        options += [cv2.CAP_PROP_N_THREADS, threads]
    loud = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG, options)
    finally:
        cv2.utils.logging.setLogLevel(loud)


def read_index(path: Path) -> bytes | None:
    """The box ``moov`` of an MP4 (ISO 14496-12), at most ``LARGEST_INDEX`` bytes.

    Returns:
        Nothing in it for an MP4 without one, as a camera leaves it whose power fails; None for
        other files.
    """
    with path.open("rb") as file:
        is_mp4 = file.read(8)[4:] in MP4_BOXES
        file.seek(0)
        while len(head := file.read(8)) == 8:
            size, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind == b"moov":
                return file.read(min(size, LARGEST_INDEX))
            if size == 1:  # a long box says its size in the next 8 bytes
                size = int.from_bytes(file.read(8), "big") - 8
            if size < 8 or not kind.isalnum():
                break
            file.seek(size - 8, 1)
    return b"" if is_mp4 else None


# --------------------------------------------------------------------------------------------------
# What FFmpeg complains about while it decodes, through its public av_log_set_callback. The callback
# needs Python's lock, so a capture is released while the log is still entered, never left to the
# garbage collector.

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
