"""H.264 access units into pictures, one for one, through OpenCV's FFmpeg."""

from __future__ import annotations

import io
import re
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.recordings.video_decoder import DecoderLog

NAL_START = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
"""Start code of Annex B, and the first byte of the unit that follows."""
SEQUENCE_PARAMETERS = 7
"""Type of a sequence parameter set (H.264, Table 7-1)."""
TYPE_MASK = 0x1F
"""Lowest five bits of a unit's first byte: its type."""

Label = TypeVar("Label")


def is_key(unit: bytes) -> bool:
    """True if decoding can begin with this access unit (Annex B): it brings its parameters."""
    kinds = (match[1][0] & TYPE_MASK for match in NAL_START.finditer(unit[:4096]))
    return SEQUENCE_PARAMETERS in kinds


class AccessUnits(io.BufferedIOBase, Generic[Label]):
    """A byte stream made of labelled access units, read as the decoder asks for it."""

    def __init__(self, units: Iterator[tuple[Label, bytes]]) -> None:
        self._units = units
        self._rest = b""
        self.read_but_not_decoded: deque[tuple[Label, bool]] = deque()
        """Their labels, and whether decoding can begin with them."""

    def read(self, size: int | None = -1) -> bytes:
        wanted = -1 if size is None else size
        while wanted < 0 or len(self._rest) < wanted:
            unit = next(self._units, None)
            if unit is None:
                break
            self.read_but_not_decoded.append((unit[0], is_key(unit[1])))
            self._rest += unit[1]
        end = len(self._rest) if wanted < 0 else wanted
        data, self._rest = self._rest[:end], self._rest[end:]
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """The stream goes forward only; FFmpeg takes -1 as no."""
        return -1

    def seekable(self) -> bool:
        return False

    def readable(self) -> bool:
        return True


def decode_units(
    units: Iterator[tuple[Label, bytes]],
) -> Iterator[tuple[Label, npt.NDArray[np.uint8] | None]]:
    """Each label with its picture [H, W, 3] RGB; None for units that gave none, or a damaged one,
    and for those after it up to the next with which decoding can begin.

    Assumes what foxglove.CompressedVideo demands: one picture a unit, no B-frames. A damaged unit
    in the middle may give no picture; then the labels after it move up by one.

    Raises:
        InputError: OpenCV has no H.264 decoder, or none that reads from memory.
    """
    import cv2

    before, first = _first_key(units)
    yield from ((label, None) for label in before)
    if first is None:
        return
    stream = AccessUnits(chain([first], units))
    source: Any = stream  # OpenCV's stubs know only its own class of streams
    # One thread: several decode ahead, so that a complaint belongs to no certain picture.
    options = [cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE, cv2.CAP_PROP_N_THREADS, 1]
    try:
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
    except (TypeError, cv2.error) as error:
        raise InputError("recorded video needs opencv-contrib-python-headless 5") from error
    damaged = False
    with DecoderLog() as decoder, ExitStack() as stack:
        stack.callback(capture.release)
        while True:
            decoded, bgr = capture.read()
            if not decoded or not stream.read_but_not_decoded:
                break
            label, key = stream.read_but_not_decoded.popleft()
            damaged = bool(decoder.complaints()) or (damaged and not key)
            if damaged:
                yield label, None
            else:
                yield label, np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    yield from ((label, None) for label, _ in stream.read_but_not_decoded)


def _first_key(
    units: Iterator[tuple[Label, bytes]],
) -> tuple[list[Label], tuple[Label, bytes] | None]:
    """Labels of the units that cannot be decoded, and the first that can."""
    before: list[Label] = []
    for label, unit in units:
        if is_key(unit):
            return before, (label, unit)
        before.append(label)
    return before, None
