"""The live loop under faults: expected state, counter and recovery, in the test's own time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from aquaflow.base.errors import AquaFlowError
from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.state import ServiceState
from aquaflow.live.service_status import WINDOW_S
from aquaflow.tracking.consistency import SHOWN_FRAMES, Cause, InconsistentKeyframe
from aquaflow.types import Dropped
from tests.live.live_scenes import CALM, Told, frame_of, rows_of, visited


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def test_a_dive_goes_from_starting_over_initialising_to_tracking(told: Told) -> None:
    told.frames("llllpp")
    assert visited(told) == ["starting", "initialising", "tracking"]
    assert all(change.reason for change in told.loop.health.changes)


def test_systemd_hears_nothing_of_ready_until_the_camera_answers_or_is_missed(told: Told) -> None:
    told.idle(1.0, turns=4)
    assert told.loop.health.state is ServiceState.STARTING
    told.idle(2.0, turns=8)
    assert visited(told) == ["starting", "waiting for camera"]


def test_an_unplugged_camera_is_waited_for_and_the_dive_goes_on(told: Told) -> None:
    told.feed.devices = {"front": {"kind": "camera", "state": "lost", "reason": "No such device"}}
    told.frames("pp")
    told.idle(10.0, turns=40)
    assert told.loop.health.state is ServiceState.WAITING
    assert "No such device" in told.loop.health.reason
    told.frames("pp", first=100)
    assert visited(told)[-3:] == ["tracking", "waiting for camera", "tracking"]
    assert told.loop.health.visits[ServiceState.WAITING] == 1


def test_lost_frames_make_it_lost_and_one_alone_does_not(told: Told) -> None:
    told.frames("pplpp")
    assert ServiceState.LOST not in told.loop.health.visits
    told.frames("lll", first=10)
    assert told.loop.health.state is ServiceState.LOST
    told.frames("p", first=20)
    assert told.loop.health.state is ServiceState.TRACKING


def test_skipped_frames_say_nothing_about_being_lost(told: Told) -> None:
    told.frames("p" + "s" * 20)
    assert told.loop.health.state is ServiceState.TRACKING


def test_a_silent_link_degrades_with_its_name_and_comes_back(told: Told) -> None:
    link = {"kind": "link", "state": "no byte for 10 s", "reason": ""}
    told.feed.devices = {"autopilot": link}
    told.frames("pp")
    assert told.loop.health.state is ServiceState.DEGRADED
    assert "autopilot" in told.loop.health.reason
    link["state"] = "connected"
    told.frames("p", first=5)
    assert told.loop.health.state is ServiceState.TRACKING


def test_tracking_that_falls_behind_is_said_and_noted_and_ends(told: Told) -> None:
    late = replace(frame_of(0), arrival_ns=time.monotonic_ns() - 900_000_000)
    for _ in range(2):
        told.clock.pass_(WINDOW_S)
        told.loop.take(late)
    assert told.loop.health.state is ServiceState.DEGRADED
    assert "too slow" in told.loop.health.reason
    assert "0.9 s behind" in told.loop.health.reason
    assert told.maps.lateness.times > 5.0
    told.frames("p" * 3, first=5, every_s=WINDOW_S)
    assert told.loop.health.state is ServiceState.TRACKING
    assert told.maps.lateness.times < 1.0
    assert f"for {2 * WINDOW_S:.0f} s" in told.loop.notes()[0]


def test_frames_that_the_map_lacks_are_noted(told: Told) -> None:
    assert told.loop.notes() == []
    told.maps.left_out["mapping frame, mapping was behind"] = 3
    (note,) = told.loop.notes()
    assert "3 tracked frames are not in the map" in note


def test_a_finding_of_the_monitor_is_a_state_with_its_reason_and_ends(told: Told) -> None:
    told.frames("pp")
    monitor = told.loop.dive_run.slam.tracker.monitor
    monitor.counts.add(InconsistentKeyframe(1, 0, Cause.POSE, 1.2))
    monitor._frames_since = 0
    told.frames("p", first=5)
    assert told.loop.health.state is ServiceState.INCONSISTENT
    assert "+20 %" in told.loop.health.reason
    monitor._frames_since = SHOWN_FRAMES
    told.frames("p", first=6)
    assert told.loop.health.state is ServiceState.TRACKING


def test_memory_pressure_goes_down_the_stated_steps_and_climbs_back(told: Told) -> None:
    told.frames("p")
    told.pressure = replace(CALM, free_memory_share=0.02)
    levels = []
    for _ in range(5):
        told.idle(told.config.limits.look_s)
        levels.append(told.degradation.level)
    assert levels == [*list(DegradationLevel)[1:], DegradationLevel.RECORDING_ONLY]
    told.frames("p", first=50)
    assert "2 % of the memory" in told.loop.health.reason
    assert "recording only" in list(rows_of(told.dive.path))[-1]
    told.pressure = CALM
    for _ in range(60):
        told.idle(told.config.limits.look_s)
    assert told.degradation.level is DegradationLevel.FULL
    assert (told.degradation.steps_down, told.degradation.steps_up) == (4, 4)
    told.frames("p", first=60)
    assert told.loop.health.state is ServiceState.TRACKING


@pytest.mark.parametrize(
    ("short", "says"),
    [
        ({"temperature_c": 95.0}, "95 degC"),
        ({"gpu_free_share": 0.01}, "GPU"),
    ],
)
def test_heat_and_a_full_gpu_are_pressure_too(
    told: Told, short: dict[str, float], says: str
) -> None:
    told.pressure = replace(CALM, **short)
    told.idle(told.config.limits.look_s)
    assert told.degradation.level is DegradationLevel.FEWER_STEPS
    assert says in told.degradation.reason


def test_work_that_found_the_gpu_full_is_asked_for_less_at_once_and_tracking_goes_on(
    told: Told,
) -> None:
    error = RuntimeError("CUDA out of memory. Tried to allocate 2.00 MiB.")
    for turn, level in enumerate(
        ("FEWER_STEPS", "SMALLER_IMAGES", "TRACKING_ONLY", "TRACKING_ONLY")
    ):
        told.slam.failures.record("optimisation", error)
        told.frames("p", first=turn, every_s=0.01)
        assert told.degradation.level is DegradationLevel[level]
    assert told.degradation.steps_down == 3
    assert told.loop.health.state is ServiceState.DEGRADED
    assert "the GPU's memory was full" in told.loop.health.reason
    told.idle(told.config.limits.calm_s)
    assert told.degradation.level is DegradationLevel.SMALLER_IMAGES


def test_a_gpu_that_stays_full_never_ends_tracking(told: Told) -> None:
    told.pressure = replace(CALM, gpu_free_share=0.01)
    told.idle(10 * told.config.limits.look_s, turns=10)
    assert told.degradation.level is DegradationLevel.TRACKING_ONLY


def test_after_heat_a_gpu_that_is_full_holds_no_deeper_level_than_it_needs(told: Told) -> None:
    told.pressure = replace(CALM, temperature_c=99.0)
    told.idle(10 * told.config.limits.look_s, turns=10)
    assert told.degradation.level is DegradationLevel.RECORDING_ONLY
    told.pressure = replace(CALM, gpu_free_share=0.01)
    told.idle(3 * told.config.limits.calm_s, turns=60)
    assert told.degradation.level is DegradationLevel.TRACKING_ONLY


def test_a_full_disk_degrades_but_costs_no_degradation_level(told: Told) -> None:
    told.frames("pp")
    told.pressure = replace(CALM, disk_free_mb=3.0)
    told.idle(told.config.limits.look_s)
    told.frames("p", first=5)
    assert told.loop.health.state is ServiceState.DEGRADED
    assert "disk full: 3 MB" in told.loop.health.reason
    assert told.degradation.level is DegradationLevel.FULL
    told.pressure = CALM
    told.idle(told.config.limits.look_s)
    told.frames("p", first=6)
    assert told.loop.health.state is ServiceState.TRACKING


def test_a_frame_that_raises_costs_itself(told: Told) -> None:
    told.frames("ppxp")
    assert told.loop.counters.failures == 1
    assert told.loop.health.state is ServiceState.TRACKING
    assert [row for row in rows_of(told.dive.path) if "failed: told so" in row]


def test_frame_after_frame_that_raises_ends_the_process(told: Told) -> None:
    with pytest.raises(AquaFlowError, match="10 frames in a row failed"):
        told.frames("x" * 10)


def test_a_source_that_fails_ends_the_loop_with_its_reason(told: Told) -> None:
    told.feed.failure = "camera 'front' failed: no such luck"
    told.feed.newest.end()
    with pytest.raises(AquaFlowError, match="no such luck"):
        told.loop.run()


def test_a_missing_picture_is_a_row_and_no_silence(told: Told) -> None:
    told.loop.take(Dropped(7, 0, "front#7 is damaged"))
    assert "front#7 is damaged" in "".join(rows_of(told.dive.path))
    assert told.loop.health.state is not ServiceState.WAITING


def test_after_the_end_there_is_no_other_state(told: Told) -> None:
    told.frames("pp")
    told.loop.end()
    told.vitals.stop("stop requested", 1.0)
    told.loop.take(frame_of(9))
    assert told.loop.health.state is ServiceState.STOPPING


def test_frames_that_a_newer_one_overtook_are_counted(told: Told) -> None:
    for index in range(4):
        told.feed.newest.put(frame_of(index))
    frame = told.feed.newest.take(0.0)
    assert frame is not None
    assert frame.index == 3
    assert told.loop.status()["overtaken"] == 3


def test_the_slowest_stage_is_named(told: Told) -> None:
    totals = told.run.profiler._totals_ms
    totals.update({"track": 1000.0, "insert": 400.0, "refine": 9000.0})
    told.clock.pass_(10.0)
    told.loop.take(None)
    assert told.loop.counters.slowest == "track"
    assert told.loop.counters.shares["track"] == pytest.approx(0.1)
