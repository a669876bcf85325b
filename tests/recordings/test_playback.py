"""Playback: the order, the pace, and the same each time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.geometry.camera import guess_camera
from aquaflow.recordings.playback import Event, Playback, arrival_of
from aquaflow.types import Depth, Dropped, Frame, TelemetrySample

MS = 1_000_000


class Pictures:
    """Ten pictures, 100 ms apart; the fourth is missing."""

    camera = None
    frame_count = 10
    notes: list[str] = []  # noqa: RUF012
    read = 0

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        for k in range(start, 10 if stop is None else stop, every):
            self.read = k
            image, camera = np.full((2, 2, 3), k, np.uint8), guess_camera(2, 2)
            t_ns = 100 * k * MS
            yield Dropped(k, t_ns, "") if k == 3 else Frame(k, t_ns, t_ns, image, camera)

    def close(self) -> None:
        self.read = -1


class Depths:
    """A depth every 40 ms that arrives 60 ms late."""

    def samples(self) -> Iterator[TelemetrySample]:
        for k in range(20):
            yield Depth(40 * k * MS, (40 * k + 60) * MS, "d", float(k))

    def close(self) -> None: ...


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 10**15

    def __call__(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += round(seconds * 1e9)


def played(speed: float | None, clock: Clock) -> Iterator[tuple[Event, int]]:
    playback = Playback(Pictures(), [Depths()], speed, clock, clock.sleep)
    for event in playback.events():
        yield event, clock.now


def facts(event: Event) -> Any:
    return (event.index, event.t_ns) if isinstance(event, (Frame, Dropped)) else event


def test_events_come_in_the_order_of_arrival() -> None:
    events = [event for event, _ in played(None, Clock())]
    assert len(events) == 30
    arrivals = [arrival_of(event) for event in events]
    assert arrivals == sorted(arrivals)


@pytest.mark.parametrize("speed", [0.5, 1.0, 8.0])
def test_the_pace_is_that_of_the_recording_times_the_speed(speed: float) -> None:
    clock = Clock()
    began = clock.now
    for event, now in played(speed, clock):
        assert now - began == pytest.approx(arrival_of(event) / speed, abs=10)


def test_every_speed_and_stepping_give_the_same_events() -> None:
    fast = [facts(event) for event, _ in played(None, Clock())]
    assert [facts(event) for event, _ in played(1.0, Clock())] == fast
    stepped = played(None, Clock())
    assert [facts(next(stepped)[0]) for _ in range(30)] == fast


def test_nothing_waits_without_a_speed() -> None:
    clock = Clock()
    began = clock.now
    assert all(now == began for _, now in played(None, clock))


def test_nothing_is_read_before_it_is_asked_for() -> None:
    pictures = Pictures()
    events = Playback(pictures, []).events()
    next(events)
    assert pictures.read == 0


def test_frames_can_be_chosen_as_of_any_camera() -> None:
    events = Playback(Pictures(), []).events(every=4, start=1, stop=9)
    assert [event.index for event in events if isinstance(event, (Frame, Dropped))] == [1, 5]


def test_closing_closes_the_sources() -> None:
    pictures = Pictures()
    Playback(pictures, [Depths()]).close()
    assert pictures.read == -1


class Broken(Depths):
    """Telemetry that fails after its first sample."""

    def samples(self) -> Iterator[TelemetrySample]:
        yield Depth(40 * MS, 100 * MS, "d", 0.0)
        raise ValueError("the log is damaged")


def test_telemetry_that_fails_ends_alone_and_is_counted() -> None:
    failures = Failures(strict=False)
    playback = Playback(Pictures(), [Broken()], failures=failures)
    events = list(playback.events())
    assert sum(isinstance(event, (Frame, Dropped)) for event in events) == 10
    assert [kind.stage for kind in failures.kinds] == ["telemetry"]
