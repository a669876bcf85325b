"""A pilot who begins, pauses and ends dives over HTTP: one process, a simulated camera, sockets.

What comes next waits for the service to have obeyed, so that nothing depends on how fast the
machine is.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from aquaflow.base.storage.dive_status import DiveState, read_status
from aquaflow.config import SourceConfig
from aquaflow.config.cameras import V4l2Config
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.frames_csv import read_rows
from aquaflow.dive.ply import read_ply
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import state_file
from aquaflow.live.control import ServiceControl
from aquaflow.live.feed import LiveFeed
from aquaflow.live.onboard import map_live
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.v4l2_kernel import V4l2Kernel
from tests.live.live_scenes import VEHICLE
from tests.live.there_and_back import ThereAndBack
from tests.small_recording import FRAMES, GIVE_UP_S, HEIGHT, WIDTH

TOKEN = "correct-horse-battery"
FPS = 5.0
"""Of the camera: a machine that is slow takes most pictures all the same."""
MORE = 4
"""Frames after which a state is taken to last."""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


class Pilot:
    """Asks the service over its socket."""

    def __init__(self, port: int) -> None:
        self._port = port

    def send(self, method: str, target: str, **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=GIVE_UP_S)
        connection.request(method, target, headers=headers)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.status, body

    def ask(self, what: str) -> tuple[int, dict[str, Any]]:
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        status, body = self.send("POST", f"/dive/{what}", **bearer)
        return status, json.loads(body)

    def health(self) -> dict[str, Any]:
        said: dict[str, Any] = json.loads(self.get("/health")[1])
        return said

    def wait(self) -> None:
        """Until the service answers."""
        deadline = time.monotonic() + GIVE_UP_S
        while time.monotonic() < deadline:
            with contextlib.suppress(ConnectionRefusedError):
                self.health()
                return
            time.sleep(0.02)

    def get(self, target: str) -> tuple[int, bytes]:
        return self.send("GET", target, Authorization=f"Bearer {TOKEN}")

    def dive(self) -> dict[str, Any]:
        found: dict[str, Any] = self.health()["dive"]
        return found

    def until(self, true: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        deadline = time.monotonic() + GIVE_UP_S
        while not true(said := self.health()):
            assert time.monotonic() < deadline, f"no {what} but {said['state']}: {said['reason']}"
            time.sleep(0.02)
        return said


@dataclass
class Story:
    """What was seen, by a name for each moment."""

    answers: dict[str, tuple[int, dict[str, Any]]] = field(default_factory=dict)
    seen: dict[str, dict[str, Any]] = field(default_factory=dict)
    pictures: dict[str, tuple[int, bytes]] = field(default_factory=dict)
    dives: Path = Path()
    problem: str = ""


class Told(threading.Thread):
    """The story, in its own thread; ends the service in any case."""

    def __init__(self, pilot: Pilot, control: ServiceControl, story: Story) -> None:
        super().__init__(name="pilot", daemon=True)
        self._pilot, self._control, self._story = pilot, control, story

    def run(self) -> None:
        try:
            self._first_dive()
            self._second_dive()
        except (AssertionError, OSError, ValueError, KeyError) as error:
            self._story.problem = repr(error)
        finally:
            self._control.stopping.set()

    def _ask(self, moment: str, what: str) -> None:
        self._story.answers[moment] = self._pilot.ask(what)

    def _see(self, moment: str) -> dict[str, Any]:
        self._story.seen[moment] = self._pilot.health()
        return self._story.seen[moment]

    def _first_dive(self) -> None:
        pilot, story = self._pilot, self._story
        pilot.wait()
        pilot.until(lambda said: pilot.get("/picture.jpg")[0] == 200, "picture while idle")
        story.pictures["idle"] = pilot.get("/picture.jpg")
        self._see("idle")
        self._ask("pause without a dive", "stop")
        self._ask("start", "start")
        pilot.until(lambda said: said["state"] == "tracking", "tracking")
        self._ask("start again", "start")
        self._see("mapping")
        self._ask("pause", "stop")
        pilot.until(lambda said: said["state"] == "paused", "pause")
        frames = pilot.dive()["frames"]
        taken = pilot.health()["devices"]["front"]["delivered"]
        pilot.until(
            lambda said: said["devices"]["front"]["delivered"] > taken + MORE, "more pictures"
        )
        paused = self._see("paused")
        assert paused["dive"]["frames"] == frames, "a picture was mapped during the pause"
        folder = Path(paused["dive"]["folder"])
        pilot.until(lambda _: state_file(folder).is_file(), "checkpoint")
        story.seen["status when paused"] = vars(read_status(folder))
        self._ask("go on", "start")
        pilot.until(lambda said: said["dive"]["frames"] > frames + MORE, "frames after the pause")

    def _second_dive(self) -> None:
        pilot, first = self._pilot, self._see("before new")["dive"]["name"]
        self._ask("new", "new")
        self._see("finishing")
        pilot.until(lambda said: said["dive"]["name"] not in (first, None), "another dive")
        pilot.until(lambda said: said["state"] == "tracking", "tracking again")
        self._see("second")
        self._ask("finish", "finish")
        self._ask("finish again", "finish")
        pilot.until(lambda said: said["state"] == "idle", "idleness")
        self._see("idle again")
        self._story.pictures["idle again"] = pilot.get("/picture.jpg")


def vehicle_at(port: int, root: Path) -> VehicleConfig:
    token = root / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    settings = VEHICLE.model_dump()
    settings["service"] |= {
        "health": {"enabled": True, "port": port, "token_file": token}, "dives": root / "dives",
    }  # fmt: skip
    settings["service"]["dive"]["begin"] = "on_command"
    return VehicleConfig.model_validate(settings)


@pytest.fixture(scope="module")
def story(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    root, port = tmp_path_factory.mktemp("pilot"), free_port()
    kernel = V4l2Kernel(root, CameraFeed(ThereAndBack(small_recording, FRAMES), FPS), None)
    asked = {"kind": "v4l2", "pixels": "YUYV", "width": WIDTH, "height": HEIGHT}
    camera = V4l2Camera(
        "front", V4l2Config.model_validate(asked | {"stall_s": 3600.0}), kernel, root
    )
    feed = LiveFeed("front", {"front": camera}, None, SourceConfig())
    control, story = ServiceControl(), Story(dives=root / "dives")
    told = Told(Pilot(port), control, story)
    told.start()
    map_live(feed, vehicle_at(port, root), control=control)
    told.join()
    return story


def test_the_service_obeyed(story: Story) -> None:
    assert story.problem == ""


def test_without_a_dive_the_service_is_idle_and_shows_the_newest_picture(story: Story) -> None:
    nothing = {"state": "idle", "name": None, "folder": None, "begun_utc": None, "frames": 0}
    assert story.seen["idle"]["dive"] == nothing
    assert story.seen["idle"]["ok"]
    for moment in ("idle", "idle again"):
        status, jpeg = story.pictures[moment]
        assert status == 200
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3)


def test_requests_that_make_sense_are_accepted_and_say_what_comes(story: Story) -> None:
    accepted = {"start": "mapping", "pause": "paused", "go on": "mapping", "new": "finishing"}
    for moment, state in (accepted | {"finish": "finishing"}).items():
        status, said = story.answers[moment]
        assert (moment, status, said["state"]) == (moment, 202, state)


def test_requests_that_make_none_are_refused_in_a_sentence(story: Story) -> None:
    for moment, reason in {
        "pause without a dive": "there is no dive",
        "start again": "mapped already",
        "finish again": "being finished",
    }.items():
        status, said = story.answers[moment]
        assert status == 409
        assert reason in said["error"]


def test_a_dive_has_a_name_a_folder_and_a_beginning(story: Story) -> None:
    dive = story.seen["mapping"]["dive"]
    assert dive["state"] == "mapping"
    assert Path(dive["folder"]) == story.dives / dive["name"]
    assert dive["begun_utc"].endswith("Z")
    assert dive["frames"] > 0


def test_a_pause_is_remembered_with_the_dive_and_has_a_checkpoint(story: Story) -> None:
    assert story.seen["paused"]["dive"]["state"] == "paused"
    assert story.seen["status when paused"]["paused"]


def test_both_dives_are_finished_with_all_their_deliverables(story: Story) -> None:
    folders = sorted(story.dives.iterdir())
    names = [story.seen[moment]["dive"]["name"] for moment in ("mapping", "second")]
    assert [folder.name for folder in folders] == sorted(names)
    for folder in folders:
        status = read_status(folder)
        assert status is not None
        assert status.state is DiveState.FINISHED
        assert len(read_ply(folder / "map.ply").means) > 0
        assert len(read_tum(folder / "trajectory.tum").positions) > 0
        assert (folder / "report.html").is_file()
        assert not (folder / "checkpoint").exists()
        assert not (folder / "work").exists()


def test_each_dive_counts_its_time_from_its_own_first_frame(story: Story) -> None:
    for folder in story.dives.iterdir():
        assert min(row.t_s for row in read_rows(folder / "frames.csv")) == 0.0


def test_after_the_end_the_service_is_idle(story: Story) -> None:
    assert story.seen["idle again"]["dive"]["state"] == "idle"
    assert story.seen["idle again"]["gaussians"] == 0
