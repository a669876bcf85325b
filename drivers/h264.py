"""Live H.264, picture by picture: each is decoded as soon as its bytes are there.

FFmpeg's reader of bare H.264 sees the end of a picture only when the next begins, a picture late.
In FLV every picture has its length and its time, so the bytes are handed over as FLV (Adobe FLV and
F4V 10.1, E.4.3; ISO/IEC 14496-15, 5.3.3.1), with a picture's number as its time: what comes out
tells which picture it is, also when one before it gave none.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Generator, Iterator
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from aquaflow.drivers.ffmpeg import video_capture

Label = TypeVar("Label")
Units = list[bytes]
"""The units (NAL) of one picture."""

START = re.compile(rb"\x00\x00\x00?\x01")
"""Start code of a unit in a byte stream (H.264, Annex B)."""
TYPE_BITS = 0x1F
"""Of a unit's first byte: its type (H.264, Table 7-1)."""
KEY_PICTURE, SEQUENCE_PARAMETERS, PICTURE_PARAMETERS = 5, 7, 8

HEADER = b"FLV\x01\x01\x00\x00\x00\x09\x00\x00\x00\x00"
"""Version 1 with video, nine bytes long; no tag before the first."""
VIDEO = b"\x09"
CONFIGURATION = b"\x17\0\0\0\0"
PICTURE = {True: b"\x17\1\0\0\0", False: b"\x27\1\0\0\0"}
"""First bytes of a video tag: key picture or not, AVC, parameters or a picture, no delay."""

MOST_FAILURES = 30
"""Pictures in a row that FFmpeg refuses before all counts as none: 1 s."""

OPTIONS = {
    "input_format": "flv",
    # Each read gives one picture, and the first tells all that FFmpeg has to know.
    "avioflags": "direct",
    "probesize": "32",
    "fpsprobesize": "0",
}


def units_of(data: bytes) -> Units:
    """The units of a byte stream (Annex B)."""
    return [unit for unit in START.split(data) if unit]


def decode(
    pictures: Iterator[tuple[Label, Units]],
) -> Generator[tuple[Label, npt.NDArray[np.uint8] | None], None, None]:
    """Each label with its picture [H, W, 3] BGR; None where the bytes make none, or need an earlier
    picture than the first that is whole by itself.

    Takes from ``pictures`` what it needs for the next picture, and no more. There are no B-frames:
    live encoders send none.

    Raises:
        ConnectionError: after the last picture, or where FFmpeg cannot decode them.
        Exception: what ``pictures`` raised, likewise.
    """
    import cv2

    source = _Flv(pictures)
    source.begin()
    yield from source.skip_before(source.first)
    if source.failure is not None:
        raise source.failure
    capture = video_capture(source, OPTIONS)
    failed_in_a_row = 0
    try:
        while failed_in_a_row < MOST_FAILURES:
            if capture.grab():
                failed_in_a_row = 0
                number = source.first + round(capture.get(cv2.CAP_PROP_POS_MSEC))
                _, shown = capture.retrieve()
                yield from source.skip_before(number)
                if number in source.labels:
                    yield source.labels.pop(number), np.asarray(shown, np.uint8)
            elif source.ended:
                break
            else:
                failed_in_a_row += 1
    finally:
        capture.release()
    if source.failure is not None:
        raise source.failure
    raise ConnectionError("its H.264 cannot be decoded" if not source.ended else "it ended")


class _Flv(io.BufferedIOBase, Generic[Label]):
    """The pictures as a file of FLV without an end, written as FFmpeg reads it."""

    def __init__(self, pictures: Iterator[tuple[Label, Units]]) -> None:
        self.labels: dict[int, Label] = {}
        """Of pictures that were read and did not come out yet."""
        self.first = 0
        """Number of the first picture that FFmpeg reads."""
        self.ended = False
        self.failure: Exception | None = None
        self._pictures = pictures
        self._count = 0
        self._parameters: Units = []
        self._rest = b""

    def begin(self) -> None:
        """Wait for a picture that is whole by itself, so that opening waits for nothing."""
        while not self._rest and not self.ended:
            self._take()

    def skip_before(self, number: int) -> Iterator[tuple[Label, None]]:
        """Those before picture ``number``: nothing came of them."""
        for each in [each for each in self.labels if each < number]:
            yield self.labels.pop(each), None

    def read(self, size: int | None = -1) -> bytes:
        if not self._rest and not self.ended:
            self._take()
        wanted = len(self._rest) if size is None or size < 0 else size
        data, self._rest = self._rest[:wanted], self._rest[wanted:]
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """The stream goes forward only; FFmpeg takes -1 as no."""
        return -1

    def seekable(self) -> bool:
        return False

    def readable(self) -> bool:
        return True

    def _take(self) -> None:
        """The next picture. An exception must not reach OpenCV: it would end the process."""
        try:
            label, units = next(self._pictures)
            number, self._count = self._count, self._count + 1
            self.labels[number] = label
            self._rest = self._tags([each for each in units if each], number)
        except StopIteration:
            self.ended = True
        except Exception as error:
            self.failure, self.ended = error, True

    def _tags(self, units: Units, number: int) -> bytes:
        """A picture, after its parameters if they are new; nothing before the first of them."""
        configured = self._parameter_tags(units, number)
        if not self._parameters:
            return b""
        return configured + _tag(
            number, PICTURE[_has(units, KEY_PICTURE)] + _length_prefixed(units)
        )

    def _parameter_tags(self, units: Units, number: int) -> bytes:
        """What precedes a picture that brings parameters other than those known."""
        kinds = (SEQUENCE_PARAMETERS, PICTURE_PARAMETERS)
        brought = [next((each for each in units if _kind(each) == kind), b"") for kind in kinds]
        if not all(brought) or brought == self._parameters:
            return b""
        header = b"" if self._parameters else HEADER
        if header:
            self.first = number
        self._parameters = brought
        return header + _tag(number, CONFIGURATION + _configuration(*brought))


def _kind(unit: bytes) -> int:
    return unit[0] & TYPE_BITS


def _has(units: Units, kind: int) -> bool:
    return any(_kind(each) == kind for each in units)


def _length_prefixed(units: Units) -> bytes:
    """Each unit after its length."""
    return b"".join(struct.pack(">I", len(unit)) + unit for unit in units)


def _configuration(sequence: bytes, picture: bytes) -> bytes:
    """AVCDecoderConfigurationRecord: lengths have four bytes, one set of each kind follows."""
    head = b"\x01" + sequence[1:4] + b"\xff"
    first = b"\xe1" + struct.pack(">H", len(sequence)) + sequence
    return head + first + b"\x01" + struct.pack(">H", len(picture)) + picture


def _tag(number: int, body: bytes) -> bytes:
    """A video tag whose time is ``number`` ms; after it, its own size."""
    low, high = number & 0xFFFFFF, number >> 24 & 0xFF
    sized = struct.pack(">I", len(body))[1:]
    times = struct.pack(">I", low)[1:] + bytes([high])
    return VIDEO + sized + times + bytes(3) + body + struct.pack(">I", 11 + len(body))
