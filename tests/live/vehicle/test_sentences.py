"""What the pilot hears: whole sentences of 50 characters at most, none of them too often."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from aquaflow.live.health import state as sentences
from aquaflow.live.health.degradation import DegradationLevel, deepest
from aquaflow.live.health.pressure import Shortage
from aquaflow.live.health.state import ServiceState
from aquaflow.live.vehicle.arming import REPEAT_S, SEVERITY, SPACING_S, PilotMessages
from aquaflow.sources.outbound import LONGEST_TEXT, StatusText
from aquaflow.survey.coverage.live_coverage import SENTENCES
from aquaflow.tracking.consistency import Cause, InconsistentKeyframe
from tests.live.live_scenes import CALM, Told

NAMES = ["a", "dvl", "front", "usb_camera_2", *("n" * length for length in range(10, 61, 3))]
LONG = "the_downward_looking_camera_under_the_skid_of_the_vehicle"
LEVELS = [level for level in DegradationLevel if level is not DegradationLevel.FULL]

EVERY_SENTENCE = {
    *sentences.OF_STATE.values(),
    *sentences.OF_CAUSE.values(),
    *SENTENCES.values(),
    *(sentences.doing_less(level, short) for level in LEVELS for short in Shortage),
    *(sentences.no_picture(name) for name in NAMES),
    *(sentences.silent_link(name, heard) for name in NAMES for heard in (False, True)),
    *(sentences.DISK_FULL, sentences.MAPPING_FAILS),
    *(sentences.STAGE_FAILS, sentences.NOT_RECORDING),
}
SENTENCE = re.compile(r"AquaFlow(:| \w)[^.]+[^ ,.]\.")


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def test_every_state_and_every_cause_has_its_sentence() -> None:
    assert set(sentences.OF_STATE) == set(ServiceState)
    assert set(sentences.OF_CAUSE) == set(Cause)
    assert set(sentences.OF_LEVEL) == set(LEVELS)
    assert set(sentences.OF_SHORTAGE) == set(Shortage)


@pytest.mark.parametrize("sentence", sorted(EVERY_SENTENCE))
def test_a_sentence_is_whole_and_fits_into_one_message(sentence: str) -> None:
    assert len(sentence.encode("ascii")) <= LONGEST_TEXT
    assert SENTENCE.fullmatch(sentence)
    assert "  " not in sentence


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_said_whole_or_not_at_all(name: str) -> None:
    for sentence in (sentences.no_picture(name), sentences.silent_link(name, True)):
        words = re.findall(r"\w+", sentence)
        assert name in words or not any(word in name for word in words if set(word) == {"n"})


# --- whatever happens to the service --------------------------------------------------------------


def link(state: str, reason: str = "no byte for 10 s") -> dict[str, object]:
    return {"kind": "link", "state": state, "reason": reason}


def heard_in(told: Told, said: str = "pp", first: int = 0) -> tuple[ServiceState, tuple[str, ...]]:
    """State and sentences after some frames; each is one of those that are tested above."""
    told.frames(said, first=first)
    health = told.loop.health
    assert set(health.sentences) <= EVERY_SENTENCE
    return health.state, health.sentences


def test_links_are_named_and_said_to_be_lost_or_never_heard(told: Told) -> None:
    told.feed.devices = {"dvl": link("lost"), "front": link("waiting"), LONG: link("lost")}
    assert heard_in(told) == (
        ServiceState.DEGRADED,
        ("AquaFlow: link dvl is lost.", "AquaFlow: nothing heard of front.",
         "AquaFlow: a link is lost."),
    )  # fmt: skip


def test_the_camera_that_is_silent_is_named(told: Told) -> None:
    told.feed.devices = {"front": {"kind": "camera", "state": "lost", "reason": "unplugged"}}
    told.frames("pp")
    told.idle(10.0)
    health = told.loop.health
    assert (health.state, health.sentences) == (
        ServiceState.WAITING,
        ("AquaFlow: no picture from camera front.",),
    )


def test_a_recording_without_devices_has_a_sentence_too(told: Told) -> None:
    told.idle(10.0)
    assert told.loop.health.sentences == ("AquaFlow: no picture from the camera.",)


@pytest.mark.parametrize(
    "short", [{"free_memory_share": 0.01}, {"gpu_free_share": 0.01}, {"temperature_c": 99.0}]
)
def test_every_level_is_told_with_what_runs_short(told: Told, short: dict[str, float]) -> None:
    told.frames("p")
    told.pressure = replace(CALM, **short)
    heard = []
    for _ in LEVELS:
        told.idle(told.config.limits.look_s)
        told.frames("p")
        heard += told.loop.health.sentences
    need = told.loop.degradation.need
    assert need is not None
    assert len(set(heard)) == deepest(need)  # one sentence for each level below FULL that helps
    assert set(heard) <= EVERY_SENTENCE


def test_disk_recorder_map_and_stages_are_told(told: Told) -> None:
    told.frames("p")
    told.pressure = replace(CALM, disk_free_mb=3.0)
    told.idle(told.config.limits.look_s)
    told.feed.devices = {"recorder": {"kind": "recorder", "state": "stopped", "reason": "disk"}}
    told.maps.failing, told.maps.last_failure = True, "grow: the GPU is gone"
    for _ in range(3):
        told.slam.failures.record("water fit", ValueError("odd"))
    state, heard = heard_in(told, first=5)
    assert state is ServiceState.DEGRADED
    assert heard == (
        sentences.DISK_FULL, sentences.MAPPING_FAILS, sentences.STAGE_FAILS,
        sentences.NOT_RECORDING,
    )  # fmt: skip


@pytest.mark.parametrize("cause", Cause)
def test_every_finding_of_the_monitor_is_told(told: Told, cause: Cause) -> None:
    told.frames("pp")
    monitor = told.slam.tracker.monitor
    monitor.counts.add(InconsistentKeyframe(1, 0, cause, 1.2))
    monitor._frames_since = 0
    assert heard_in(told, "p", 5) == (ServiceState.INCONSISTENT, (sentences.OF_CAUSE[cause],))


# --- how often ------------------------------------------------------------------------------------


def said(told: Told) -> list[StatusText]:
    return [word for word in told.feed.told if isinstance(word, StatusText)]


def test_the_urgency_is_that_of_the_state() -> None:
    assert SEVERITY[ServiceState.WAITING] == "error"
    assert SEVERITY[ServiceState.LOST] == SEVERITY[ServiceState.DEGRADED] == "warning"
    assert (
        SEVERITY.get(ServiceState.STOPPING, "info")
        == SEVERITY.get(ServiceState.STARTING, "info")
        == "info"
    )


def test_each_trouble_is_told_once_while_it_lasts_and_a_second_one_is_not_hidden(
    told: Told,
) -> None:
    report = PilotMessages(told.config.report, told.feed)
    told.frames("pp")
    devices = told.feed.devices = {"dvl": link("lost")}
    for second in range(60):
        if second == 20:
            devices["sonar"] = link("waiting")
        if second == 40:
            devices.clear()
        told.frames("p", first=10 + second)
        report.update(told.loop, float(second))
    assert [(word.severity, word.text) for word in said(told)] == [
        ("warning", "AquaFlow: link dvl is lost."),
        ("warning", "AquaFlow: nothing heard of sonar."),
        ("notice", "AquaFlow is tracking."),
    ]


def test_a_state_that_flaps_repeats_no_sentence_too_soon(told: Told) -> None:
    report, draw = PilotMessages(told.config.report, told.feed), random.Random(0)
    health, when = told.loop.health, {}
    for tenth in range(6000):
        state = draw.choice(
            [ServiceState.TRACKING, ServiceState.LOST, ServiceState.DEGRADED, ServiceState.WAITING]
        )
        troubles = ("AquaFlow: link dvl is lost.",) if state is ServiceState.DEGRADED else ()
        health.set(state, "it flaps", troubles)
        before = len(said(told))
        report.update(told.loop, tenth / 10)
        for word in said(told)[before:]:
            when.setdefault(word.text, []).append(tenth / 10)
    every = sorted(at for times in when.values() for at in times)
    assert len(when) == 4
    assert all(later - at >= SPACING_S for at, later in pairwise(every))
    for times in when.values():
        assert all(later - at >= REPEAT_S for at, later in pairwise(times))
        assert len(times) > 20  # and it goes on being told


def test_a_state_that_came_back_too_soon_is_told_when_it_may_be(told: Told) -> None:
    report, health = PilotMessages(told.config.report, told.feed), told.loop.health
    for second, state in (
        (0, ServiceState.LOST),
        (2, ServiceState.TRACKING),
        (4, ServiceState.LOST),
    ):
        health.set(state, "it flaps")
        report.update(told.loop, float(second))
    for second in range(5, 30):
        report.update(told.loop, float(second))
    lost, tracking = (
        sentences.OF_STATE[ServiceState.LOST],
        sentences.OF_STATE[ServiceState.TRACKING],
    )
    assert [word.text for word in said(told)] == [lost, tracking, lost]


def test_the_end_of_the_service_is_told(told: Told) -> None:
    report = PilotMessages(told.config.report, told.feed)
    told.loop.watchers.append(report.update)
    told.frames("pp")
    told.loop.vitals.stop("stop requested", 1.0)
    told.loop.tell_watchers()
    assert [word.text for word in said(told)][-1] == sentences.OF_STATE[ServiceState.STOPPING]


def test_nothing_is_told_where_the_config_says_so(tmp_path: Path) -> None:
    quiet = Told(tmp_path / "quiet", report={"status_text": False, "values": False})
    quiet.frames("pp")
    PilotMessages(quiet.config.report, quiet.feed).update(quiet.loop, 0.0)
    assert quiet.feed.told == []
    quiet.close()
