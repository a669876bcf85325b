"""A day with a BlueROV2: dives by button, by command and by arming, a dead stream, a power cut."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from aquaflow.base.storage.dive_status import DiveState, read_status
from aquaflow.dive.ply import read_ply
from aquaflow.drivers.protocol.mavlink import ACCEPTED, FIRST_COMMAND, OUR_COMPONENT, REFUSED_NOW
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import state_file
from aquaflow.sources.outbound import LONGEST_TEXT
from tests.browser import Browser, needs_browser
from tests.live.bluerov2.simulated_bluerov2 import PING, TOKEN, BlueRov2, program

pytest.importorskip("pymavlink", reason="pymavlink is not installed")
pytestmark = pytest.mark.ci

MORE = 4
"""Frames after which something is taken to go on."""
MOST = 15
"""Frames that outnumber those that waited for the first keyframe when the power was cut."""
START, STOP, FINISH = FIRST_COMMAND, FIRST_COMMAND + 1, FIRST_COMMAND + 2
PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""


def vehicle(
    recording: Path, root: Path, begin: str = "on_command", finish: str = "on_command"
) -> BlueRov2:
    return BlueRov2(recording, root, begin, finish)


def folder_of(said: dict[str, Any]) -> Path:
    return Path(said["dive"]["folder"])


def assert_finished(dive: Path) -> None:
    status = read_status(dive)
    assert status is not None
    assert status.state is DiveState.FINISHED
    assert len(read_ply(dive / "map.ply").means) > 0
    assert len(read_tum(dive / "trajectory.tum").positions) > 0
    assert (dive / "report.html").is_file()


def hears(source: str, kind: str, said: dict[str, Any]) -> bool:
    """Whether /health shows a quantity of a sender."""
    return any(source in name and kind in kinds for name, kinds in said["telemetry"].items())


@pytest.fixture
def rov(small_recording: Path, tmp_path: Path) -> Iterator[BlueRov2]:
    with vehicle(small_recording, tmp_path).switched_on() as rov:
        yield rov


def test_every_instrument_is_heard_and_the_pilot_too_in_whole_sentences(rov: BlueRov2) -> None:
    rov.start()
    rov.until_state("idle")
    assert rov.ask("start") == 202
    rov.until_state("tracking")
    for source, kind in (
        ("autopilot", "depth"), ("autopilot", "attitude"), (str(PING), "altitude"),
        ("dvl", "velocity"),
    ):  # fmt: skip
        rov.until(partial(hears, source, kind), f"{kind} of {source}")
    rov.until(lambda _: "AquaFlow is tracking." in rov.autopilot.texts, "a sentence")
    assert all(len(text) <= LONGEST_TEXT for text in rov.autopilot.texts)
    assert rov.stop() == 0


def test_a_dead_stream_is_told_once_and_its_return_once(rov: BlueRov2) -> None:
    rov.start()
    rov.ask("start")
    rov.until_state("tracking")
    rov.camera.sending.clear()
    said = rov.until_state("waiting for camera")
    assert "no picture" in said["reason"]
    rov.until(lambda _: any("no picture" in text for text in rov.autopilot.texts), "a sentence")
    rov.camera.sending.set()
    said = rov.until_state("tracking")
    frames = said["dive"]["frames"]
    rov.until(lambda said: said["dive"]["frames"] > frames + MORE, "frames after the silence")
    dead = [text for text in rov.autopilot.texts if "no picture" in text]
    assert dead == ["AquaFlow: no picture from camera pilot."]
    # A busy computer may track too slowly for a while, and says so by "degraded".
    states = [change["after"] for change in rov.health()["changes"]]
    states = [state for state in states[states.index("tracking") :] if state != "degraded"]
    assert [state for state, _ in groupby(states)] == ["tracking", "waiting for camera", "tracking"]


def test_a_power_cut_costs_no_dive(rov: BlueRov2) -> None:
    rov.start()
    rov.ask("start")
    dive = folder_of(rov.until_state("tracking"))
    rov.until(lambda said: state_file(dive).is_file(), "checkpoint")
    rov.kill()
    rov.start()  # goes on by itself, though dives begin on command
    said = rov.until_state("tracking")
    assert folder_of(said) == dive
    frames = said["dive"]["frames"]
    rov.until(lambda said: said["dive"]["frames"] > frames + MOST, "frames after the power cut")
    # What came after the last checkpoint is lost in the next cut, and a busy computer writes late.
    written = state_file(dive).stat().st_mtime_ns
    rov.until(lambda said: state_file(dive).stat().st_mtime_ns > written, "checkpoint")
    rov.kill()
    done = subprocess.run(
        [program(), "run", "finish", str(dive)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert_finished(dive)
    rov.start()
    rov.until_state("idle")


@pytest.mark.slow
def test_a_ground_station_begins_and_ends_a_dive(rov: BlueRov2) -> None:
    rov.start()
    rov.until_state("idle")
    rov.autopilot.command(STOP, OUR_COMPONENT)
    rov.until(lambda _: bool(rov.autopilot.acknowledged), "an answer")
    rov.autopilot.command(START, OUR_COMPONENT)
    dive = folder_of(rov.until_state("tracking"))
    rov.autopilot.command(FINISH, OUR_COMPONENT)
    rov.until_state("idle")
    assert_finished(dive)
    assert rov.autopilot.acknowledged == [
        (STOP, REFUSED_NOW), (START, ACCEPTED), (FINISH, ACCEPTED)
    ]  # fmt: skip


@pytest.mark.slow
def test_each_arming_is_a_dive(small_recording: Path, tmp_path: Path) -> None:
    with vehicle(small_recording, tmp_path, "when_armed", "when_disarmed").switched_on() as rov:
        rov.start()
        rov.until_state("idle")
        folders = []
        for _ in range(2):
            rov.autopilot.armed = True
            folders.append(folder_of(rov.until_state("tracking")))
            rov.autopilot.armed = False
            rov.until_state("idle")
        assert len(set(folders)) == 2
        for folder in folders:
            assert_finished(folder)


@needs_browser
def test_a_pilot_dives_with_the_buttons_of_the_page(rov: BlueRov2, tmp_path: Path) -> None:
    browser = Browser(tmp_path / "profile")
    try:
        browser.emulate(1280, 1000)
        rov.start()
        browser.open(f"http://127.0.0.1:{rov.port}/")
        browser.wait("!document.querySelector('#login').hidden")
        browser.type("#token", TOKEN)
        browser.click("#login button")
        browser.click("[data-action=start]")
        browser.wait("document.querySelector('#state').textContent === 'Tracking'")
        browser.wait("document.querySelector('#plan-frame polyline')")
        browser.wait("document.querySelector('#picture-frame img')?.naturalWidth")
        dive = folder_of(rov.health())
        shown(browser, "bluerov2")
        rov.camera.sending.clear()
        browser.wait("document.querySelector('#reason').textContent.includes('no picture')")
        shown(browser, "bluerov2-without-pictures")
        rov.camera.sending.set()
        browser.wait("document.querySelector('#state').textContent === 'Tracking'")
        browser.click("[data-action=finish]")
        browser.wait("document.querySelector('dialog').open")
        browser.click("#agree")
        browser.wait("document.querySelector('#state').textContent === 'Idle'")
        shown(browser, "bluerov2-finished")
    finally:
        browser.close()
    assert_finished(dive)
    assert json.loads((dive / "metrics.json").read_text())["tracked"] > 0


def shown(browser: Browser, name: str) -> None:
    """A picture for people; only where they ask for it."""
    if PICTURES is not None:
        browser.screenshot(Path(PICTURES) / f"{name}.png")
