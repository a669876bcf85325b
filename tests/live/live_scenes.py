"""A service that is told everything: frames without pictures' cost, pressure, and time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from aquaflow.base.clocks.device import Learned
from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import Config, parse_config
from aquaflow.config.service import ServiceConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.run import DiveRun
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.live.clock_reading import Continued
from aquaflow.live.control import ServiceControl
from aquaflow.live.feed import LatestSamples
from aquaflow.live.health.degradation import Degradation
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.pressure import Pressure
from aquaflow.live.health.state import Health
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.loop import LiveLoop
from aquaflow.live.map_thread import MapThread
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.work import Growth, Insertion
from aquaflow.slam import Slam
from aquaflow.sources.newest import Newest
from aquaflow.sources.outbound import HearsPilot, OutboundMessage
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import CameraModel, Dropped, Frame

WIDTH, HEIGHT = 64, 48
CALM = Pressure(free_memory_share=0.5, disk_free_mb=50_000.0, temperature_c=40.0)
SETTINGS = parse_config({"threads": 1, "mapping": {"medium": {"enabled": False}}}, "test")


FEW = {"steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1, "refine_steps": 4}
VEHICLE = VehicleConfig.model_validate(
    {
        "threads": 1,
        "mapping": {"optimiser": FEW, "medium": {"fit": False}},
        "service": {
            "health": {"enabled": False, "port": 8230},
            "mapping": {"backlog": 100, "steps_per_view": 0, "nice": 0},
            "checkpoint": {"every_s": 1e6},
            "hang_s": 600.0,  # a test may leave a dive without a turn for as long as it needs
        },
    }
)
"""One that maps quickly, and takes checkpoints when it is told to."""


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now

    def pass_(self, seconds: float) -> None:
        self.now += seconds


def frame_of(index: int) -> Frame:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    arrival_ns = time.monotonic_ns()
    return Frame(index, index * 100_000_000, arrival_ns, image, guess_camera(WIDTH, HEIGHT))


class ToldFeed:
    """Frames that the test puts there itself."""

    def __init__(self) -> None:
        self.newest: Newest[Frame | Dropped] = Newest()
        self.latest_samples, self.notes = LatestSamples(), []
        self.failure: str | None = None
        self.failures = Failures()
        self.calibration: CameraModel | None = None
        self.devices: dict[str, dict[str, object]] = {}
        self.continued = Continued()
        self.told: list[OutboundMessage] = []
        self.learned: dict[str, Learned] = {}
        self.mounting: MountingConfig | None = None

    lasting = False
    pilot: HearsPilot | None = None

    def name_of(self, index: int) -> str:
        return f"told#{index}"

    def take(self, timeout_s: float) -> Frame | Dropped | None:
        return self.newest.take(timeout_s)

    def forget(self) -> None:
        self.failures, self.notes = Failures(), []
        self.latest_samples.forget()

    def stated_mounting(self) -> MountingConfig | None:
        return self.mounting

    def describe(self) -> dict[str, dict[str, object]]:
        return self.devices

    def continue_from(self, continued: Continued) -> None:
        self.continued = continued

    def dive_s(self) -> float | None:
        return None

    def clocks(self) -> dict[str, Learned]:
        return self.learned

    def send(self, message: OutboundMessage) -> bool:
        self.told.append(message)
        return True

    def start(self) -> None: ...

    def close(self) -> None: ...


class ToldRun(DiveRun):
    """Decides as it is told: 'p' a pose, 'l' lost, 's' skipped, 'x' an exception."""

    said = ""

    def frame(self, frame: Frame) -> list[Tracked]:
        said, self.said = self.said[:1] or "p", self.said[1:]
        if said == "x":
            raise ValueError("told so")
        if said == "p":
            tracked = Tracked(frame, FrameClass.COMMON, 0, 0, Sim3.identity())
        else:
            kind = FrameClass.LOST if said == "l" else FrameClass.SKIPPED
            tracked = Tracked(frame, kind, 0)
        self.decide([tracked])
        return [tracked]


class Told:
    """A live loop of which the test holds every end."""

    def __init__(self, folder: Path, config: Config = SETTINGS, **service: object) -> None:
        self.clock, self.feed, self.control = Clock(), ToldFeed(), ServiceControl()
        self.pressure = CALM
        self.config = ServiceConfig.model_validate(service)
        self.vitals = ServiceHealth(self.config)
        self.vitals.health = Health(self.clock)
        self.vitals.degradation = Degradation(self.config.limits, self.clock)
        self.degradation, self.heartbeats = self.vitals.degradation, self.vitals.heartbeats
        self.maps = MapThread(
            Maps(config), self.config.mapping, self.heartbeats, lambda: self.degradation.level
        )
        self.dive = DiveFolder(folder, config)
        self.slam = Slam(config, worker=Worker(threads=True), maps=self.maps)
        self.run = ToldRun("told", self.dive, config, self.slam, None, self.feed.name_of)
        self.loop = LiveLoop(
            self.run, self.feed, self.maps, self.config, self.vitals, self.control,
            lambda: self.pressure, self.clock,
        )  # fmt: skip

    def frames(self, said: str, first: int = 0, every_s: float = 0.1) -> None:
        """One turn of the loop for each letter."""
        for i, letter in enumerate(said):
            self.run.said = letter
            self.clock.pass_(every_s)
            self.loop.take(frame_of(first + i))

    def idle(self, seconds: float, turns: int = 1) -> None:
        """Turns of the loop without a frame."""
        for _ in range(turns):
            self.clock.pass_(seconds / turns)
            self.loop.take(None)

    def close(self) -> None:
        self.slam.close()
        self.dive.close()
        self.vitals.close()


class RecordedMaps(Maps):
    """Maps that only remember what they were asked to do."""

    def __init__(self) -> None:
        super().__init__(SETTINGS)
        self.asked: list[str] = []
        self.fail, self.failed = False, threading.Event()

    def grow(self, growth: Growth) -> None:
        if self.fail:
            self.failed.set()
            raise RuntimeError("the GPU is gone")
        self.views.keep(growth.view)
        size = growth.view.camera.width
        self.asked.append(f"grow {growth.view.frame_index} {size}px {growth.steps}")
        for each in growth.retired:
            self.insert(each)

    def insert(self, insertion: Insertion) -> None:
        self.asked.append(f"insert {insertion.view.frame_index}")


def caught_up(dive: LiveDive) -> None:
    """Give the loop time for the past, and wait until mapping has done all that was asked for."""
    dive.parts.maps.lateness.times = 0.0  # frames of a file arrived long ago, and none waits
    while dive.parts.slam.tracker.past is not None:
        dive.parts.loop.take(None)
    done = threading.Event()
    dive.parts.maps._post("wait", lambda maps: done.set())
    assert done.wait(60.0)


def visited(told: Told) -> list[str]:
    """The states that the service was in, in their order."""
    return ["starting", *(change.after.value for change in told.loop.health.changes)]


def rows_of(folder: Path) -> Iterable[str]:
    return (folder / "frames.csv").read_text().splitlines()[1:]
