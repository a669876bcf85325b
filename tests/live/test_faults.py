"""A dive on simulated devices to which everything happens: it goes on, and says what happened.

The devices speak their real protocols (V4L2 calls, MAVLink over a pseudo terminal); the service is
the whole of ``aquaflow run`` but its sockets. What happens next waits for the service to have
noticed what happened before, so that nothing here depends on how fast the machine is.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from aquaflow.config import SourceConfig
from aquaflow.config.cameras import V4l2Config
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.dive.frames_csv import read_rows
from aquaflow.dive.log import EarlyRecords
from aquaflow.drivers.live import CameraState
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.feed import LiveFeed
from aquaflow.live.health.state import ServiceState
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.loop import PATIENCE_S
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.wires import PtyWire
from aquaflow.sim_drivers.v4l2_kernel import V4l2Kernel
from aquaflow.types import Depth
from tests.live.live_scenes import VEHICLE, Clock
from tests.live.there_and_back import ThereAndBack
from tests.small_recording import GIVE_UP_S

FPS = 10.0
FOR_EVER_S = 3600.0
"""A device is silent for so long only if it was unplugged."""
JUMP_S = 1e6
"""By so much the camera's clock is set on; no test takes that long."""
PICTURES = 3
"""Shown after something happened, so that it is among the rows."""
GARBAGE_BYTES = 300_000


@dataclass
class Told:
    """What the service said when something had happened to it."""

    reason: dict[str, str] = field(default_factory=dict)
    problem: str = ""
    garbage_bytes: int = 0
    clock_set: int = 0
    """The newest picture when the camera's clock was set on."""
    unplugged: int = 0
    """The newest picture when the camera was unplugged."""
    reconnects: int = 0
    dive: LiveDive | None = None


class Fate(threading.Thread):
    """Does to the devices what happens at sea, and waits for the service to notice."""

    def __init__(
        self, dive: LiveDive, camera: V4l2Camera, kernel: V4l2Kernel, wire: PtyWire, told: Told
    ) -> None:
        super().__init__(name="fate", daemon=True)
        self._loop, self._feed, self._told = dive.parts.loop, dive.feed, told
        self._camera, self._kernel, self._wire = camera, kernel, wire
        self._clock = Clock()
        # A machine that is slow has not lost its camera: time passes when the test says so.
        self._clock.now = time.monotonic()
        self._loop._now_s = self._clock

    def run(self) -> None:
        try:
            self._until(ServiceState.TRACKING)
            self._wire.unplug()
            self._told.reason["link away"] = self._until(ServiceState.DEGRADED)
            self._wire.plug()
            self._told.reason["link back"] = self._until(ServiceState.TRACKING)
            self._flood()
            self._told.clock_set = self._shown()
            self._kernel.feed.set_clock_on(JUMP_S)
            self._more_pictures()
            self._lose_the_camera()
            self._more_pictures()
        except AssertionError as error:
            self._told.problem = str(error)
        finally:
            self._loop.control.stopping.set()

    def _lose_the_camera(self) -> None:
        self._told.unplugged = self._shown()
        self._kernel.unplug()
        self._wait(lambda: self._camera.state is not CameraState.STREAMING, "camera lost")
        self._clock.pass_(2.0 * PATIENCE_S)
        self._told.reason["camera away"] = self._until(ServiceState.WAITING)
        self._kernel.plug_in()
        self._told.reason["camera back"] = self._until(ServiceState.TRACKING)
        self._told.reconnects = self._camera.counters.reconnects

    def _shown(self) -> int:
        return -1 if self._loop.picture is None else self._loop.picture.index

    def _more_pictures(self) -> None:
        seen = self._shown()
        self._wait(lambda: self._shown() >= seen + PICTURES, "more pictures")

    def _until(self, state: ServiceState) -> str:
        self._wait(lambda: self._loop.health.state is state, f"'{state.value}'")
        return self._loop.health.reason

    def _flood(self) -> None:
        noise = random.Random(0)
        for _ in range(GARBAGE_BYTES // 1000):
            self._wire.send(noise.randbytes(1000))
        self._wait(lambda: self._garbage() > GARBAGE_BYTES // 2, "garbage to be counted")
        self._told.garbage_bytes = self._garbage()
        self._told.reason["flooded"] = self._until(ServiceState.TRACKING)

    def _garbage(self) -> int:
        return int(str(self._feed.describe()["autopilot"]["garbage_bytes"]))

    def _wait(self, true: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + GIVE_UP_S
        while not true():
            now = f"{self._loop.health.state.value}: {self._loop.health.reason}"
            assert time.monotonic() < deadline, f"no {what} but {now}"
            time.sleep(0.02)


@pytest.fixture(scope="module")
def told(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Told:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    EarlyRecords().attach()  # as service.sources.devices does
    root = tmp_path_factory.mktemp("at_sea")
    kernel = V4l2Kernel(root, CameraFeed(ThereAndBack(small_recording), FPS), None)
    asked = {"kind": "v4l2", "pixels": "YUYV", "width": 160, "height": 120}
    asked |= {"stall_s": FOR_EVER_S, "first_retry_s": 0.05, "last_retry_s": 0.1}
    camera = V4l2Camera("front", V4l2Config.model_validate(asked), kernel, root)
    wire = PtyWire(root / "autopilot")
    link = {"kind": "serial", "port": str(wire.path), "baud": 115200}
    device = {"kind": "mavlink", "link": link, "silence_s": FOR_EVER_S}
    links = LinkTelemetry(parse_telemetry({"devices": {"autopilot": device}}, "test"))
    samples = [Depth(i * 50_000_000, i * 50_000_000, "truth", 3.0) for i in range(4000)]
    autopilot = SimulatedDevice(ArduSub(), wire, samples).start()
    feed = LiveFeed("front", {"front": camera}, links, SourceConfig())
    told = Told()
    with LiveDive("sea", resume_folder(root / "dive", new=False), feed, VEHICLE) as dive:
        told.dive = dive
        fate = Fate(dive, camera, kernel, wire, told)
        fate.start()
        dive.run()
        fate.join()
    autopilot.close()
    return told


def test_nothing_ended_the_dive(told: Told) -> None:
    assert told.problem == ""


def test_a_silent_link_is_named_and_comes_back(told: Told) -> None:
    assert told.reason["link away"].startswith("link 'autopilot': ")
    assert told.reason["link back"] == "every frame has a pose"


def test_garbage_is_counted_and_degrades_nothing(told: Told) -> None:
    assert told.garbage_bytes > GARBAGE_BYTES // 2
    assert told.reason["flooded"] == "every frame has a pose"


def test_an_unplugged_camera_is_waited_for_with_its_reason(told: Told) -> None:
    assert told.reason["camera away"].startswith("no picture for 4 s: ")
    assert told.reason["camera back"] == "every frame has a pose"
    assert told.reconnects == 1


def test_frames_go_on_in_one_map_where_the_camera_comes_back(told: Told) -> None:
    assert told.dive is not None
    rows = read_rows(told.dive.folder.path / "frames.csv")
    after = [row for row in rows if row.index > told.unplugged and row.keyframe is not None]
    assert after
    assert {row.sub_map for row in rows if row.keyframe is not None} == {0}


def test_a_camera_whose_clock_is_set_on_changes_no_time(told: Told) -> None:
    assert told.dive is not None
    rows = read_rows(told.dive.folder.path / "frames.csv")
    assert min(row.index for row in rows) <= told.clock_set < max(row.index for row in rows)
    assert max(abs(later - t_s) for t_s, later in pairwise(row.t_s for row in rows)) < 0.5 * JUMP_S


def test_the_counts_of_all_this_are_kept_with_the_dive(told: Told) -> None:
    assert told.dive is not None
    live = told.dive.parts.run.live
    assert live is not None
    assert live["visits"]["waiting for camera"] == 1
    assert live["visits"]["degraded"] == 1
    assert live["failures"] == 0


def logged(told: Told, source: str) -> list[dict[str, Any]]:
    """The entries of the dive's log about one device."""
    assert told.dive is not None
    lines = (told.dive.folder.path / "log.jsonl").read_text().splitlines()
    return [entry for line in lines if (entry := json.loads(line)).get("source") == source]


def comings_and_goings(entries: list[dict[str, Any]]) -> list[str]:
    """Without what depends on how fast the machine is: attempts in between, clocks, summaries."""
    told = ("format", "connected", "lost", "reconnected")
    return [entry["event"] for entry in entries if entry["event"] in told]


def summed_up(entries: list[dict[str, Any]], counter: str) -> int:
    """Over the summaries of a dive that may have taken minutes."""
    return sum(entry["counts"].get(counter, 0) for entry in entries if entry["event"] == "errors")


def test_the_log_holds_what_happened_to_each_device_in_its_order(told: Told) -> None:
    happened = ["connected", "lost", "reconnected"]
    assert comings_and_goings(logged(told, "autopilot")) == happened
    camera = logged(told, "front")
    assert comings_and_goings(camera) == ["format", *happened]
    assert camera[0]["message"] == "camera 'front' gives 160 x 120 YUYV, 30 pictures/s"


def test_the_log_tells_when_by_the_dives_clock_and_in_utc(told: Told) -> None:
    entries = [*logged(told, "front"), *logged(told, "autopilot")]
    rows = read_rows(told.dive.folder.path / "frames.csv") if told.dive is not None else []
    for entry in entries:
        utc = datetime.fromisoformat(entry["utc"].replace("Z", "+00:00"))
        assert 0.0 <= time.time() - utc.timestamp() < 2 * GIVE_UP_S
    before_the_first_frame = {entry["event"] for entry in entries if entry["t_s"] is None}
    assert before_the_first_frame <= {"waiting", "connected", "format"}
    (lost,) = [entry["t_s"] for entry in logged(told, "front") if entry["event"] == "lost"]
    unplugged_s = next(row.t_s for row in rows if row.index >= told.unplugged)
    assert unplugged_s <= lost < rows[-1].t_s


def test_the_log_sums_up_what_could_not_be_read(told: Told) -> None:
    assert summed_up(logged(told, "autopilot"), "garbage_bytes") > GARBAGE_BYTES // 2
    assert summed_up(logged(told, "front"), "stamps_repaired") >= 1
