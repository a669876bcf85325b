"""A dive on simulated devices to which everything happens: it goes on, and says what happened.

The devices speak their real protocols (V4L2 calls, MAVLink over a pseudo terminal); the service is
the whole of ``aquaflow run`` but its sockets. What happens next waits for the service to have
noticed what happened before, so that nothing here depends on how fast the machine is.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest

from aquaflow.config import SourceConfig
from aquaflow.config.cameras import V4l2Config
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.dive.frames_csv import read_rows
from aquaflow.drivers.live import CameraState
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.messages import CameraModel, Depth, Frame
from aquaflow.service.checkpoint.resume import resumed
from aquaflow.service.feed import LiveFeed
from aquaflow.service.health.state import State
from aquaflow.service.live_dive import LiveDive
from aquaflow.service.loop import PATIENCE_S
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.wires import PtyWire
from aquaflow.sim_drivers.v4l2_kernel import V4l2Kernel
from aquaflow.sources import open_recording
from tests.service.live_scenes import VEHICLE, Clock
from tests.small_recording import GIVE_UP_S

FPS = 10.0
PLACE = 8
"""Pictures that all see the same place: a machine that takes only some of them stays on course."""
FOR_EVER_S = 3600.0
"""A device is silent for so long only if it was unplugged."""
JUMP_S = 1e6
"""By so much the camera's clock is set on; no test takes that long."""
PICTURES = 3
"""Shown after something happened, so that it is among the rows."""
GARBAGE_BYTES = 300_000


class ThereAndBack:
    """The begin of a recording forwards and backwards, for ever: no place changes at once."""

    camera: CameraModel | None = None
    frame_count: int | None = None

    def __init__(self, recording: Path) -> None:
        source = open_recording(recording)
        frames = source.frames(stop=PLACE)
        self._seen = [frame for frame in frames if isinstance(frame, Frame)]
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        yield from self._seen
        yield from self._seen[-2:0:-1]

    def close(self) -> None: ...


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
            self._until(State.TRACKING)
            self._wire.unplug()
            self._told.reason["link away"] = self._until(State.DEGRADED)
            self._wire.plug()
            self._told.reason["link back"] = self._until(State.TRACKING)
            self._flood()
            self._told.clock_set = self._shown()
            self._kernel.feed.set_clock_on(JUMP_S)
            self._more_pictures()
            self._lose_the_camera()
            self._more_pictures()
        except AssertionError as error:
            self._told.problem = str(error)
        finally:
            self._loop.stopping.set()

    def _lose_the_camera(self) -> None:
        self._told.unplugged = self._shown()
        self._kernel.unplug()
        self._wait(lambda: self._camera.state is not CameraState.STREAMING, "camera lost")
        self._clock.pass_(2.0 * PATIENCE_S)
        self._told.reason["camera away"] = self._until(State.WAITING)
        self._kernel.plug_in()
        self._told.reason["camera back"] = self._until(State.TRACKING)
        self._told.reconnects = self._camera.counters.reconnects

    def _shown(self) -> int:
        return -1 if self._loop.picture is None else self._loop.picture.index

    def _more_pictures(self) -> None:
        seen = self._shown()
        self._wait(lambda: self._shown() >= seen + PICTURES, "more pictures")

    def _until(self, state: State) -> str:
        self._wait(lambda: self._loop.health.state is state, f"'{state.value}'")
        return self._loop.health.reason

    def _flood(self) -> None:
        noise = random.Random(0)
        for _ in range(GARBAGE_BYTES // 1000):
            self._wire.send(noise.randbytes(1000))
        self._wait(lambda: self._garbage() > GARBAGE_BYTES // 2, "garbage to be counted")
        self._told.garbage_bytes = self._garbage()
        self._told.reason["flooded"] = self._until(State.TRACKING)

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
    with LiveDive("sea", resumed(root / "dive", new=False), feed, VEHICLE) as dive:
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
