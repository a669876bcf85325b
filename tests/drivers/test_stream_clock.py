"""How old a picture is, by the time that its stream carries."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.drivers.stream.capture import PACED, StreamClock

MS = 1_000_000
PERIOD = 33 * MS
STREAM_ZERO = 7_000_000 * MS
"""What the stream's time shows when the host's clock shows 0."""


def ages_ms(clock: StreamClock, taken: np.ndarray, arrivals: np.ndarray) -> list[float | None]:
    """How old each picture was when it arrived; None: not known."""
    moments = [
        clock.moment(int(t) + STREAM_ZERO, int(arrival))
        for t, arrival in zip(taken, arrivals, strict=True)
    ]
    return [
        None if moment is None else (arrival - moment) / MS
        for moment, arrival in zip(moments, arrivals, strict=True)
    ]


@pytest.fixture
def taken() -> np.ndarray:
    return 10**12 + PERIOD * np.arange(900, dtype=np.int64)


def test_pictures_of_a_quiet_stream_have_no_age(taken: np.ndarray) -> None:
    ages = ages_ms(StreamClock("s"), taken, taken + 20 * MS)
    assert ages[: PACED - 1] == [None] * (PACED - 1)
    assert np.max(ages[PACED - 1 :]) == 0.0


def test_what_was_held_back_is_as_old_as_it_is(taken: np.ndarray) -> None:
    arrivals = taken + 20 * MS
    arrivals[300:400] = np.maximum(arrivals[300:400], arrivals[399])
    ages = ages_ms(StreamClock("s"), taken, arrivals)
    expected = (arrivals[300:400] - taken[300:400]) / MS - 20.0
    assert np.allclose(ages[300:400], expected)
    assert ages[300] == pytest.approx(99 * 33.0)
    assert ages[400] == 0.0


def test_jitter_is_age_beyond_the_shortest_way(taken: np.ndarray) -> None:
    jitter = np.random.default_rng(0).exponential(10 * MS, len(taken)).astype(np.int64)
    ages = ages_ms(StreamClock("s"), taken, taken + jitter)
    known = np.array([age for age in ages if age is not None])
    assert len(known) > 880
    assert np.abs(np.sort(known)[-100:] - np.sort(jitter / MS)[-100:]).max() < 1.0


@pytest.mark.parametrize("drift_ppm", [-200, 200, 1000, -1000])
def test_drift_is_no_age(drift_ppm: int) -> None:
    taken = 10**12 + 200 * MS * np.arange(1000, dtype=np.int64)  # 200 s
    drifted = taken + (taken - taken[0]) * drift_ppm // 1_000_000
    ages = ages_ms(StreamClock("s"), drifted, taken + 20 * MS)
    assert np.max(ages[PACED:]) < 0.1 * abs(drift_ppm)


def test_a_backlog_at_the_start_is_left_out_until_the_stream_is_read_as_it_comes(
    taken: np.ndarray,
) -> None:
    """A server that begins with three seconds of the past, decoded at 100 pictures/s."""
    arrivals = np.maximum(taken + 20 * MS, taken[90] + 10 * MS * np.arange(900))
    ages = ages_ms(StreamClock("s"), taken, arrivals)
    caught_up = int(np.argmin(arrivals - taken))
    assert all(age is None for age in ages[:caught_up])
    assert np.max(ages[caught_up + PACED :]) == 0.0


@pytest.mark.parametrize("jump_s", [-5.0, 5.0, 3600.0, -1e5])
def test_a_time_that_begins_anew_is_learned_anew(taken: np.ndarray, jump_s: float) -> None:
    arrivals = taken + 20 * MS
    jumped = taken.copy()
    jumped[400:] += round(jump_s * 1e9)
    ages = ages_ms(StreamClock("s"), jumped, arrivals)
    after = ages[400 : 400 + 3 + PACED]
    assert all(age is None or age > 4000.0 for age in after[:2])
    assert np.max(ages[400 + 3 + PACED :]) == 0.0


def test_a_sender_that_paused_looks_late_by_its_pause(taken: np.ndarray) -> None:
    """Its time stood still meanwhile; opening the stream anew sets it right."""
    arrivals = taken + 20 * MS
    arrivals[400:] += 5_000 * MS
    ages = ages_ms(StreamClock("s"), taken, arrivals)
    assert ages[450] == pytest.approx(5000.0)
