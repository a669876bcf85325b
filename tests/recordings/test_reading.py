"""Recordings whose reader raises: in the middle, at the end, at once, or from one frame on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.config import SourceConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.recordings.playback import MOST_UNREADABLE, read_past_failures
from aquaflow.types import Depth, Dropped, Frame

COUNT = 20
CAMERA = guess_camera(8, 6)
PICTURE = np.zeros((6, 8, 3), np.uint8)


class Reader:
    """Yields frames, with a depth after each, and raises before those in ``at``; COUNT: at its
    close."""

    def __init__(self, at: set[int], source: SourceConfig | None = None) -> None:
        self.at, self.source = at, source or SourceConfig()
        self.failures, self.given_up = Failures(strict=False), list[int]()

    def __call__(self, start: int) -> Iterator[Frame | Depth]:
        for index in range(start, self.source.stop or COUNT, self.source.every):
            if index in self.at:
                raise OSError(5, "planted")
            yield Frame(index, 10 * index, 10 * index, PICTURE, CAMERA)
            yield Depth(10 * index, 10 * index, "truth", 1.0)
        if COUNT in self.at:
            raise OSError(5, "planted")

    def all(self, count: int | None = COUNT) -> list[Frame | Dropped]:
        """The frames, read or dropped."""
        give_up = self.given_up.append
        events = read_past_failures(
            self, self.source.start, self.source, count, self.failures, give_up
        )
        return [event for event in events if isinstance(event, (Frame, Dropped))]


def test_a_frame_that_cannot_be_read_costs_itself() -> None:
    reader = Reader({5, 6, 11})
    frames = reader.all()
    assert [frame.index for frame in frames] == list(range(COUNT))
    dropped = [frame for frame in frames if isinstance(frame, Dropped)]
    assert [(frame.index, frame.t_ns) for frame in dropped] == [(5, 40), (6, 40), (11, 100)]
    assert reader.failures.total == 3
    assert reader.given_up == []


def test_a_step_of_several_frames_is_kept() -> None:
    reader = Reader({9}, SourceConfig(start=3, every=3))
    assert [frame.index for frame in reader.all()] == list(range(3, COUNT, 3))


@pytest.mark.parametrize("source", [SourceConfig(), SourceConfig(every=3), SourceConfig(stop=15)])
def test_a_failure_after_the_last_frame_adds_none(source: SourceConfig) -> None:
    reader, whole = Reader({COUNT}, source), Reader(set(), source)
    expected = [frame.index for frame in whole.all()]
    assert [frame.index for frame in reader.all()] == expected
    assert reader.failures.total == 1
    assert reader.given_up == []


def test_a_recording_that_fails_again_and_again_is_given_up() -> None:
    reader = Reader(set(range(8, COUNT)))
    frames = reader.all()
    assert [frame.index for frame in frames] == list(range(8 + MOST_UNREADABLE))
    assert reader.given_up == [8 + MOST_UNREADABLE]


def test_a_recording_that_fails_at_once_raises_the_error_of_its_reader() -> None:
    with pytest.raises(OSError, match="planted"):
        Reader({0}).all()
