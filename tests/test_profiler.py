"""The profiler: counts, totals and percentiles per stage, on a clock that the test turns."""

from __future__ import annotations

import pytest

from aquaflow import profiler
from aquaflow.profiler import Profiler


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(profiler, "time", clock)
    return clock


def test_a_stage_counts_its_runs_in_milliseconds(clock: Clock) -> None:
    measured = Profiler()
    for ms in (1.0, 2.0, 3.0, 4.0, 100.0):
        with measured.stage("track"):
            clock.now_s += ms / 1e3
    assert measured.summary() == {
        "track": {"count": 5, "total": 110.0, "p50": 3.0, "p95": pytest.approx(80.8)}
    }


def test_nested_stages_each_count_their_own_wall_time(clock: Clock) -> None:
    measured = Profiler()
    with measured.stage("outer"):
        clock.now_s += 0.010
        with measured.stage("inner"):
            clock.now_s += 0.005
    summary = measured.summary()
    assert summary["outer"]["total"] == 15.0
    assert summary["inner"]["total"] == 5.0


def test_a_stage_that_raises_is_measured_and_the_error_goes_on(clock: Clock) -> None:
    measured = Profiler()

    def breaks() -> None:
        with measured.stage("map"):
            clock.now_s += 0.007
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        breaks()
    assert measured.summary()["map"]["count"] == 1
    assert measured.summary()["map"]["total"] == 7.0


def test_stages_keep_the_order_in_which_they_first_ended(clock: Clock) -> None:
    measured = Profiler()
    for name in ("encode", "match", "encode"):
        with measured.stage(name):
            clock.now_s += 0.001
    assert list(measured.summary()) == ["encode", "match"]


def test_nothing_measured_is_an_empty_summary() -> None:
    assert Profiler().summary() == {}
