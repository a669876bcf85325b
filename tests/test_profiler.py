"""The profiler: counts, totals and percentiles per stage, on a clock that the test turns."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from aquaflow.base import stages as profiler
from aquaflow.base.stages import Profiler
from tests.command_line import Cli
from tests.small_recording import QUICK


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


def test_top_level_time_counts_nested_stages_once(clock: Clock) -> None:
    measured = Profiler()
    with measured.stage("frame"):
        clock.now_s += 0.010
        with measured.stage("track"):
            clock.now_s += 0.005
    with measured.stage("write"):
        clock.now_s += 0.002
    assert measured.top_level_s == pytest.approx(0.017)


def test_a_stage_after_one_that_raised_is_top_level_again(clock: Clock) -> None:
    measured = Profiler()
    with pytest.raises(RuntimeError), measured.stage("outer"), measured.stage("inner"):
        raise RuntimeError("broken")
    with measured.stage("next"):
        clock.now_s += 0.004
    assert measured.top_level_s == pytest.approx(0.004)


def test_stages_of_another_thread_are_measured_and_not_added_to_the_top_level() -> None:
    measured = Profiler(trace=True)

    def work() -> None:
        with measured.stage("aside"):
            pass

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    with measured.stage("main"):
        pass
    assert set(measured.summary()) == {"aside", "main"}
    aside, main = measured.chrome_trace()["traceEvents"]
    assert aside["tid"] != main["tid"]
    assert measured.top_level_s == pytest.approx(main["dur"] * 1e-6, abs=1e-8)


def test_a_trace_holds_every_run_in_microseconds(clock: Clock) -> None:
    measured = Profiler(trace=True)
    clock.now_s += 1.0
    with measured.stage("outer"):
        clock.now_s += 0.001
        with measured.stage("inner"):
            clock.now_s += 0.002
    inner, outer = measured.chrome_trace()["traceEvents"]
    assert (inner["name"], inner["ph"], inner["args"]["depth"]) == ("inner", "X", 1)
    assert (outer["name"], outer["ph"], outer["args"]["depth"]) == ("outer", "X", 0)
    assert (outer["ts"], outer["dur"]) == (pytest.approx(1e6), pytest.approx(3e3))
    assert (inner["ts"], inner["dur"]) == (pytest.approx(1.001e6), pytest.approx(2e3))


def test_without_trace_no_run_is_kept(clock: Clock) -> None:
    measured = Profiler()
    with measured.stage("track"):
        clock.now_s += 0.001
    assert measured.chrome_trace()["traceEvents"] == []


def test_a_profiled_dive_has_a_trace_whose_stages_cover_its_wall_time(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    ran = aquaflow("map", small_recording, "--out", dive, "--profile", *QUICK)
    assert ran.code == 0, ran.err
    events = json.loads((dive / "trace.json").read_text())["traceEvents"]
    for event in events:
        assert event["ph"] == "X"
        assert {"name", "ts", "dur", "pid", "tid"} <= set(event)
        assert event["dur"] >= 0.0
    metrics = json.loads((dive / "metrics.json").read_text())
    top_s = sum(event["dur"] for event in events if event["args"]["depth"] == 0) * 1e-6
    assert 0.97 <= top_s / metrics["wall_s"] <= 1.001
    counts = {name: stage["count"] for name, stage in metrics["stage_ms"].items()}
    assert counts == {name: sum(e["name"] == name for e in events) for name in counts}


def test_without_profile_a_dive_has_no_trace(small_dive: Path) -> None:
    assert not (small_dive / "trace.json").exists()
