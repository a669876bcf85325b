"""One process and its dives: what begins by itself, what is left when something fails."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.base.worker import stop_on_signals
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live import onboard as module
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.control import DivePhase, ServiceControl, ServiceRequest
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.live_dive import STAGE
from aquaflow.live.onboard import Onboard, OnboardSettings, map_live
from aquaflow.live.service_frontends import ServiceFrontends
from aquaflow.live.service_status import ServiceStatus
from tests.live.live_scenes import VEHICLE, ToldFeed
from tests.live.unfinished_dives import unfinished


class LastingFeed(ToldFeed):
    """A camera that may send pictures for ever, and sends none."""

    lasting = True

    def __init__(self) -> None:
        super().__init__()
        self.forgotten = 0

    def forget(self) -> None:
        super().forget()
        self.forgotten += 1


def vehicle(dives: Path, begin: str = "on_command") -> VehicleConfig:
    settings = VEHICLE.model_dump()
    settings["service"]["dives"] = dives
    settings["service"]["dive"]["begin"] = begin
    return VehicleConfig.model_validate(settings)


@dataclass
class FakeDive:
    """A dive without a map: it ends when the pilot wants it to."""

    control: ServiceControl
    does: Callable[[FakeDive], None]
    was_paused: bool = False
    finished: list[str] = field(default_factory=list)
    parts: Any = None

    def __post_init__(self) -> None:
        standing = SimpleNamespace(was_paused=self.was_paused)
        self.parts = SimpleNamespace(standing=standing)

    def map(self) -> None:
        self.does(self)

    def finish(self, progress: object = None) -> Any:
        return "finished"

    def __enter__(self) -> FakeDive:
        return self

    def __exit__(self, *_: object) -> None: ...


class Service:
    """Onboard with dives that the test makes, and turns of its idle time that the test sees."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, begin: str) -> None:
        self.feed, self.control = LastingFeed(), ServiceControl()
        self.vehicle = vehicle(root / "dives", begin)
        self.vitals = ServiceHealth(self.vehicle.service)
        self.station = ServiceFrontends(self.feed, self.vehicle, self.control, self.vitals)
        self.onboard = Onboard(self.feed, self.vehicle, self.control, self.station)
        self.begun: list[OnboardSettings] = []
        self.dives: list[FakeDive] = []
        self.idle: list[Callable[[], None]] = [self.control.stopping.set]
        """What happens in the turns without a dive, one after the other."""
        monkeypatch.setattr(module, "begin_dive", self._begin)
        monkeypatch.setattr(ServiceFrontends, "show", lambda station, dive: None)
        monkeypatch.setattr("aquaflow.live.idle_loop.TURN_S", 0.01)
        self.station.standby.watchers.append(self._turn)

    def _begin(self, feed: object, vehicle: object, asked: OnboardSettings, *_: object) -> FakeDive:
        self.begun.append(asked)
        return self.dives[len(self.begun) - 1]

    def start(self) -> None:
        self.control.ask(ServiceRequest.START)

    def _turn(self, standby: ServiceStatus) -> None:
        if self.control.phase is DivePhase.IDLE and self.idle:
            self.idle.pop(0)()

    def serve(self, asked: OnboardSettings | None = None) -> Any:
        try:
            return self.onboard.serve(asked or OnboardSettings())
        finally:
            self.station.close()
            self.vitals.close()


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Service:
    return Service(tmp_path, monkeypatch, "on_command")


def asking(request: ServiceRequest = ServiceRequest.FINISH) -> Callable[[FakeDive], None]:
    """A dive during which the pilot asks for something."""

    def ask(dive: FakeDive) -> None:
        dive.control.ask(request)

    return ask


def test_nothing_begins_before_the_pilot_asks_and_then_dives_follow_each_other(
    service: Service,
) -> None:
    service.dives = [
        FakeDive(service.control, asking()),
        FakeDive(service.control, asking(ServiceRequest.NEW)),
        FakeDive(service.control, asking()),
    ]
    seen: list[int] = []

    def start() -> None:
        seen.append(len(service.begun))
        service.start()

    service.idle = [start, start, service.control.stopping.set]
    assert service.serve() == "finished"
    assert seen == [0, 1]  # the third dive followed the second without being idle
    assert [asked.new for asked in service.begun] == [False, False, True]
    assert service.feed.forgotten == 3


def test_a_folder_by_name_is_the_first_dives_and_the_others_are_beside(service: Service) -> None:
    service.dives = [FakeDive(service.control, asking()) for _ in range(2)]
    service.idle = [service.start, service.start, service.control.stopping.set]
    service.serve(OnboardSettings(Path("here")))
    assert service.begun == [OnboardSettings(Path("here")), OnboardSettings(Path("here"), new=True)]


def test_a_dive_that_cannot_be_begun_leaves_the_service_idle_with_the_reason(
    tmp_path: Path,
) -> None:
    (tmp_path / "dives").write_text("not a folder")
    control, feed, reasons = ServiceControl(), LastingFeed(), list[str]()
    with ServiceHealth(VEHICLE.service) as vitals:
        station = ServiceFrontends(feed, vehicle(tmp_path / "dives"), control, vitals)

        def look(standby: ServiceStatus) -> None:
            reasons.append(standby.health.reason)
            if len(reasons) == 1:
                control.ask(ServiceRequest.START)
            elif "came to nothing" in reasons[-1]:
                control.stopping.set()

        station.standby.watchers.append(look)
        Onboard(feed, vehicle(tmp_path / "dives"), control, station).serve(OnboardSettings())
        station.close()
    assert "cannot make the dive folder" in reasons[-1]


def test_the_first_dive_at_once_must_begin(tmp_path: Path) -> None:
    (tmp_path / "dives").write_text("not a folder")
    with pytest.raises(InputError, match="cannot make the dive folder"):
        map_live(LastingFeed(), vehicle(tmp_path / "dives", "at_once"))


def test_a_dive_whose_files_find_no_room_leaves_the_service_idle(service: Service) -> None:
    def full(progress: object = None) -> None:
        raise InputError("the disk is full")

    dive = FakeDive(service.control, asking())
    dive.finish = full  # type: ignore[method-assign]
    service.dives, reasons = [dive], []

    def look() -> None:
        reasons.append(service.vitals.health.reason)
        service.control.stopping.set()

    service.idle = [service.start, look]
    assert service.serve() is None
    assert reasons == ["the last dive came to nothing: the disk is full"]


def test_a_camera_that_is_gone_for_good_ends_the_service_also_while_it_is_idle(
    service: Service,
) -> None:
    service.idle = [lambda: setattr(service.feed, "failure", "camera 'front' failed: gone")]
    with pytest.raises(AquaFlowError, match="camera 'front' failed: gone; the service ends"):
        service.serve()


@pytest.mark.parametrize(
    ("state", "begins"),
    [
        (DiveState.OPEN, True),
        (DiveState.STOPPED, False),
        (DiveState.FINISHING, False),
        (DiveState.FINISHED, False),
        (None, False),
    ],
)
def test_a_dive_that_a_crash_cut_off_goes_on_without_the_pilots_word(
    service: Service, tmp_path: Path, state: DiveState | None, begins: bool
) -> None:
    dives, now = tmp_path / "dives", ClockReading.now()
    dives.mkdir()
    if state is not None:
        unfinished(dives, taken=now, state=state)
        DiveStatus(state, False, None, now.boot, None).write(dives / "old")
    service.dives = [FakeDive(service.control, asking())]
    service.serve()
    assert len(service.begun) == begins


def test_a_paused_dive_is_paused_again_in_the_next_process(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Onboard, "_begins_by_itself", lambda *_: True)
    seen: list[DivePhase] = []

    def look(dive: FakeDive) -> None:
        seen.append(dive.control.phase)
        dive.control.ask(ServiceRequest.FINISH)

    service.dives = [FakeDive(service.control, look, was_paused=True)]
    service.serve()
    assert seen == [DivePhase.PAUSED]


def test_a_paused_dive_that_the_pilot_starts_is_not_paused(service: Service) -> None:
    seen: list[DivePhase] = []

    def look(dive: FakeDive) -> None:
        seen.append(dive.control.phase)
        dive.control.ask(ServiceRequest.FINISH)

    service.dives = [FakeDive(service.control, look, was_paused=True)]
    service.idle = [service.start, service.control.stopping.set]
    service.serve()
    assert seen == [DivePhase.MAPPING]


def test_a_finishing_that_takes_far_longer_than_its_time_is_hung() -> None:
    with ServiceHealth(VEHICLE.service) as vitals:
        now = vitals.heartbeats._now_s()
        vitals.heartbeats.beat(STAGE, ahead_s=100.0)
        assert vitals.heartbeats.find_hung_stage(60.0) is None
        vitals.heartbeats._now_s = lambda: now + 155.0
        assert vitals.heartbeats.find_hung_stage(60.0) is None
        vitals.heartbeats._now_s = lambda: now + 165.0
        assert vitals.heartbeats.find_hung_stage(60.0) == STAGE
        vitals.heartbeats.retire(STAGE)


def test_the_first_signal_stops_and_the_next_is_the_systems() -> None:
    before, stopping = signal.getsignal(signal.SIGTERM), threading.Event()
    with stop_on_signals(stopping, once=True):
        signal.raise_signal(signal.SIGTERM)
        assert stopping.is_set()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) is before
