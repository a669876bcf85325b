"""The computer's own clock as a source of UTC."""

from __future__ import annotations

import threading
import time

import pytest

from aquaflow.live.clock_reading import WallClock
from aquaflow.types import UtcTime

SECOND = 1_000_000_000
UTC_NS = 1_795_365_000 * SECOND


def test_both_clocks_are_read_until_it_is_closed_and_a_jump_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monotonic, utc = iter([5, 6, 7]), iter([UTC_NS, UTC_NS + 1, UTC_NS - 60 * SECOND])
    monkeypatch.setattr(time, "monotonic_ns", lambda: next(monotonic))
    monkeypatch.setattr(time, "time_ns", lambda: next(utc))
    clock = WallClock(every_s=0.0)

    heard = []
    for sample in clock.samples():
        heard.append(sample)
        if len(heard) == 3:
            clock.close()

    (told,) = caplog.records
    assert told.fields == {"event": "clock", "source": "computer"}  # type: ignore[attr-defined]
    assert told.getMessage().startswith("the wall clock was set by -60.000 s")
    assert heard == [
        UtcTime(5, 5, "computer/clock", UTC_NS),
        UtcTime(6, 6, "computer/clock", UTC_NS + 1),
        UtcTime(7, 7, "computer/clock", UTC_NS - 60 * SECOND),
    ]


def test_a_clock_that_was_never_set_says_nothing_until_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    utc = iter([9, 10, UTC_NS])
    monkeypatch.setattr(time, "time_ns", lambda: next(utc))

    sample = next(iter(WallClock(every_s=0.0).samples()))

    assert sample.utc_ns == UTC_NS


def test_closing_ends_the_wait() -> None:
    clock = WallClock(every_s=3600.0)
    samples = clock.samples()
    next(samples)
    threading.Timer(0.01, clock.close).start()

    assert list(samples) == []
