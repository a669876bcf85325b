"""Live H.264: a picture is there as soon as its bytes are, and is known by its label."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest

from aquaflow.drivers.h264 import Units, decode, units_of
from aquaflow.sim_drivers.h264_writer import access_unit
from aquaflow.sim_drivers.h264_writer import units as written

COUNT = 20


def image(number: int, width: int = 64) -> np.ndarray:
    return np.full((48, width, 3), 5 * number, np.uint8)


class Sent:
    """Pictures of a camera, and how many were taken from it."""

    def __init__(self, damaged: dict[int, bytes] | None = None, first: int = 0) -> None:
        self.taken = 0
        self._damaged, self._first = damaged or {}, first

    def __iter__(self) -> Iterator[tuple[str, Units]]:
        for number in range(COUNT):
            self.taken += 1
            parts = written(image(number), number)
            if number < self._first:
                parts = parts[2:]  # without its parameters
            if number in self._damaged:
                parts = [self._damaged[number]]
            yield f"picture {number}", parts


def shown(sent: Iterator[tuple[str, Units]]) -> list[tuple[str, int | None]]:
    """Each label with the number that its picture tells; at the end comes the end."""
    found = []
    with suppress(ConnectionError):
        for label, bgr in decode(sent):
            found.append((label, None if bgr is None else round(float(bgr.mean()) / 5.0)))
    return found


def expected(missing: set[int]) -> list[tuple[str, int | None]]:
    return [(f"picture {n}", None if n in missing else n) for n in range(COUNT)]


def test_each_picture_is_there_before_the_next_is_taken() -> None:
    sent = Sent()
    pictures = decode(iter(sent))
    for number in range(COUNT):
        label, bgr = next(pictures)
        assert label == f"picture {number}"
        assert bgr is not None
        assert bgr.shape == (48, 64, 3)
        assert sent.taken == number + 1


@pytest.mark.parametrize("damage", [b"\x65garbage", b"\x01", b""])
def test_bytes_that_make_no_picture_cost_their_own_label(damage: bytes) -> None:
    assert shown(iter(Sent({5: damage, 9: damage}))) == expected({5, 9})


def test_what_comes_before_the_first_parameters_is_no_picture() -> None:
    assert shown(iter(Sent(first=4))) == expected({0, 1, 2, 3})


def test_a_camera_that_sends_no_parameters_shows_nothing() -> None:
    assert shown(iter(Sent(first=COUNT))) == []


def test_what_the_camera_raises_is_raised_after_its_last_picture() -> None:
    def failing() -> Iterator[tuple[int, Units]]:
        for number in range(3):
            yield number, written(image(number), number)
        raise TimeoutError("no picture for 3 s")

    pictures = decode(failing())
    assert [next(pictures)[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(TimeoutError, match="no picture for 3 s"):
        next(pictures)


def test_a_byte_stream_is_taken_apart_at_its_start_codes() -> None:
    assert units_of(access_unit(image(3), 3)) == written(image(3), 3)
    assert units_of(b"\0\0\1\x09\xf0\0\0\0\1\x67ab") == [b"\x09\xf0", b"\x67ab"]
    assert units_of(b"") == []
