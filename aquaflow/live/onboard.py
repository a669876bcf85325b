"""``aquaflow run``: dives one after the other, as the pilot asks for them."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import AquaFlowError, ConfigError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.dive_status import DiveState, read_status
from aquaflow.base.worker import stop_on_signals
from aquaflow.config.instruments import DbcConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.log import EarlyRecords
from aquaflow.dive.run import Finished
from aquaflow.live.checkpoint.checkpoint import UnusableStateError
from aquaflow.live.checkpoint.generations import SetAside
from aquaflow.live.checkpoint.resume import Choice, choose, is_begun, resume_folder, tidy
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.control import DivePhase, ServiceControl, ServiceRequest
from aquaflow.live.feed import Feed, LiveFeed, PlaybackFeed, record_mountings
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.state import ServiceState
from aquaflow.live.idle_loop import FINISHING, IDLE
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.live.service_frontends import ServiceFrontends
from aquaflow.live.vehicle.arming import refuse_without_autopilot
from aquaflow.mapping.work import Progress
from aquaflow.recordings.playback import Playback
from aquaflow.sources import (
    notes_with,
    open_camera,
    open_links,
    open_recording,
    telemetry_reader,
)
from aquaflow.types import CameraModel

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OnboardSettings:
    """Where the dives go."""

    out: Path | None = None
    """The first dive's folder; None: one in ``service.dives`` for each."""
    new: bool = False
    """Begin a new dive, even if one could be resumed."""
    overwrite: bool = False
    """A dive that is in ``out`` already, instead of going on with it."""


def map_live(
    feed: Feed,
    vehicle: VehicleConfig,
    out: Path | None = None,
    new: bool = False,
    seconds: float | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
    control: ServiceControl | None = None,
) -> Finished | None:
    """Map what ``feed`` brings until it ends, ``seconds`` have passed, or it is stopped; where
    pictures may come for ever, in as many dives as are asked for in ``control``.

    Args:
        out: the dive's folder, or a new one next to it if it holds another dive; None: the
            unfinished dive in ``service.dives``, or a new one there.
        new: start a new dive even if one could be resumed.
        overwrite: a dive that is in ``out`` already, instead of going on with it.

    Returns the last dive; None where nothing could be mapped.

    Raises:
        AquaFlowError: the folder, the config, the source or the loop; the checkpoint stays.
    """
    if vehicle.service.pose.enabled:
        refuse_without_scale(vehicle)
    if feed.lasting:
        refuse_without_autopilot(vehicle)
    control = control or ServiceControl()
    with contextlib.ExitStack() as around:
        around.callback(feed.close)
        vitals = around.enter_context(ServiceHealth(vehicle.service))
        station = around.enter_context(ServiceFrontends(feed, vehicle, control, vitals))
        around.callback(_stop_after(seconds, control).cancel)
        around.enter_context(stop_on_signals(control.told, control.stopping, once=True))
        onboard = Onboard(feed, vehicle, control, station, progress)
        return onboard.serve(OnboardSettings(out, new, overwrite))


class Onboard:
    """One process of the service."""

    def __init__(
        self,
        feed: Feed,
        vehicle: VehicleConfig,
        control: ServiceControl,
        station: ServiceFrontends,
        progress: Progress | None = None,
    ) -> None:
        self._feed, self._vehicle, self._control = feed, vehicle, control
        self._station, self._progress = station, progress
        self._reason = IDLE

    def serve(self, asked: OnboardSettings) -> Finished | None:
        """Dives and idle times, until the service shall end or nothing comes any more.

        Raises:
            AquaFlowError: the source, the loop, the first dive's beginning or the last one's end.
        """
        control, finished = self._control, None
        automatic = self._begins_by_itself(asked)
        if automatic:
            control.ask(ServiceRequest.START)
        while not control.stopping.is_set():
            if control.phase is DivePhase.IDLE:
                self._idle()
                continue
            self._reason = IDLE
            finished = self._dive(asked, automatic)
            control.end_dive()
            if not self._feed.lasting:
                break
            self._feed.forget()
            asked, automatic = OnboardSettings(asked.out, new=asked.out is not None), False
        return finished

    def _idle(self) -> None:
        self._feed.start()
        self._station.standby.turn(ServiceState.IDLE, self._reason)
        if self._feed.failure is not None:
            raise AquaFlowError(f"{self._feed.failure}; the service ends, to be started anew")

    def _begins_by_itself(self, asked: OnboardSettings) -> bool:
        """Without a pilot's word: as the config says, and where a process was cut off in a dive."""
        if not self._feed.lasting or self._vehicle.service.dive.begin == "at_once":
            return True
        choice = choose_dive_folder(self._vehicle, asked)
        status = read_status(choice.folder)
        interrupted = status is not None and status.state is DiveState.OPEN
        return choice.checkpoint is not None and interrupted

    def _dive(self, asked: OnboardSettings, automatic: bool) -> Finished | None:
        """One dive from its first frame to its report."""
        control, station, another = self._control, self._station, self._control.begin()
        asked = OnboardSettings(asked.out, asked.new or another, asked.overwrite)
        try:
            dive = begin_dive(self._feed, self._vehicle, asked, station.standby.vitals, control)
        except AquaFlowError as error:
            if automatic:
                raise
            self._came_to_nothing(error)
            return None
        with dive:
            if automatic and dive.parts.standing.was_paused:
                control.ask(ServiceRequest.STOP)
            station.show(dive)
            try:
                dive.map()
                return self._finish_dive(dive)
            finally:
                station.hide()

    def _finish_dive(self, dive: LiveDive) -> Finished | None:
        """The end of a dive in a thread of its own, while the service goes on to answer."""
        control = self._control
        with ThreadPoolExecutor(1, "finishing") as threads:
            work = threads.submit(dive.finish, self._progress)
            work.add_done_callback(lambda _: control.wake())
            while not work.done():
                self._station.standby.turn(ServiceState.FINISHING, FINISHING)
            self._station.standby.end()
        try:
            return work.result()
        except AquaFlowError as error:
            if control.stopping.is_set() or not self._feed.lasting:
                raise
            self._came_to_nothing(error)
            return None

    def _came_to_nothing(self, error: AquaFlowError) -> None:
        """What a pilot asked for failed; he may ask again."""
        log.error("%s", error)
        self._reason = f"the last dive came to nothing: {error}"


def begin_dive(
    feed: Feed,
    vehicle: VehicleConfig,
    asked: OnboardSettings,
    vitals: ServiceHealth | None = None,
    control: ServiceControl | None = None,
) -> LiveDive:
    """The dive of :func:`map_live`, before its first frame. If a checkpoint cannot be resumed, the
    one before is used, and then a new dive; in an unattended run also if the config does not fit.

    Raises:
        AquaFlowError: the folder, or the config.
    """
    while True:
        choice = choose_dive_folder(vehicle, asked)
        folder = choice.folder
        replaces = asked.overwrite or is_begun(folder)
        try:
            return LiveDive(folder.name, choice, feed, vehicle, replaces, vitals, control)
        except UnusableStateError as error:
            assert choice.checkpoint is not None
            log.error("%s", error)
            SetAside(folder).move(choice.checkpoint.file, str(error))
        except AquaFlowError as error:
            if choice.checkpoint is None or asked.out is not None:
                raise
            log.error("%s: %s; a new dive begins", folder, error)
            asked = OnboardSettings(new=True)


def choose_dive_folder(vehicle: VehicleConfig, asked: OnboardSettings) -> Choice:
    """The folder, and what is resumed in it."""
    if asked.out is not None:
        return Choice(asked.out) if asked.overwrite else resume_folder(asked.out, asked.new)
    service = vehicle.service
    choice = choose(service.dives, service.checkpoint, asked.new, ClockReading.now())
    tidy(service.dives, choice)
    return choice


def _stop_after(seconds: float | None, control: ServiceControl) -> threading.Timer:
    timer = threading.Timer(seconds or 0.0, control.stopping.set)
    timer.daemon = True
    if seconds is not None:
        timer.start()
    return timer


# --------------------------------------------------------------------------------------------------
# Whether anything that is configured can give the map metres.

METRIC_SAMPLES = {"depth", "velocity", "altitude"}
"""Samples of a DBC device that are lengths, or lengths per second."""
METRIC_MESSAGES = {"LOCAL_POSITION_NED", "VFR_HUD", "DISTANCE_SENSOR"}
"""Messages of an autopilot that hold a length, in addition to the external pressure."""


def refuse_without_scale(vehicle: VehicleConfig) -> None:
    """A service that shall send poses must have a source of metres.

    Raises:
        ConfigError: nothing that is configured can ever give the map's scale.
    """
    devices, fusion = vehicle.telemetry.devices.values(), vehicle.fusion
    lengths = bool(fusion.boards) or fusion.lasers is not None
    if fusion.enabled and (lengths or any(_is_metric(device) for device in devices)):
        return
    raise ConfigError(
        "service.pose.enabled: nothing here can give the map's scale in metres, so that no pose "
        "may steer the vehicle; set it to false, or add to telemetry.devices one that measures "
        "depth, velocity or altitude, or set fusion.boards or fusion.lasers; with fusion.enabled"
    )


def _is_metric(device: AnyDevice) -> bool:
    if isinstance(device, MavlinkConfig):
        messages = METRIC_MESSAGES.intersection(device.messages)
        return device.external_pressure is not None or bool(messages)
    if isinstance(device, DbcConfig):
        return any(signal.sample in METRIC_SAMPLES for signal in device.samples)
    return True


# --------------------------------------------------------------------------------------------------
# The feed that a config or a path describes.


def devices(vehicle: VehicleConfig) -> LiveFeed:
    """The vehicle's cameras and links, with a recorder if ``service.record`` is set. A camera that
    is not there yet is waited for.

    Raises:
        ConfigError: ``service.camera`` names none of the cameras.
        InputError: a driver or the library that it needs is not installed.
    """
    EarlyRecords().attach()  # links are opened before the dive has a folder
    name = vehicle.service.camera or next(iter(vehicle.cameras))
    if name not in vehicle.cameras:
        known = ", ".join(vehicle.cameras)
        raise ConfigError(f"service.camera is '{name}'; the cameras are: {known}")
    cameras = {key: open_camera(key, config) for key, config in vehicle.cameras.items()}
    recorder = _recorder(vehicle) if vehicle.service.record else None
    if recorder is not None:
        record_mountings(recorder, vehicle, cameras)
    tap = None if recorder is None else recorder.raw
    links = open_links(vehicle.telemetry, tap) if vehicle.telemetry.devices else None
    return LiveFeed(name, cameras, links, vehicle.source, recorder)


def _recorder(vehicle: VehicleConfig) -> Recorder:
    """One folder for each start of the service: a recording is never appended to."""
    folder = vehicle.service.dives / time.strftime("recording-%Y%m%d-%H%M%S")
    return Recorder(folder, vehicle.recording)


def recording(
    path: Path,
    vehicle: VehicleConfig,
    speed: float = 1.0,
    calibration: CameraModel | None = None,
) -> PlaybackFeed:
    """The recording at ``path``, played back in real time, ``speed`` times as fast.

    Raises:
        InputError: nothing is there, or no installed source reads it.
    """
    camera = open_recording(path, fps=vehicle.source.fps)
    reader = telemetry_reader(path)
    telemetry = [] if reader is None else [reader.open(path)]
    failures = Failures()
    playback = Playback(camera, telemetry, speed, failures=failures)
    known = calibration or camera.camera
    notes = notes_with(camera, known)
    return PlaybackFeed(playback, vehicle.source, known, camera.name_of, notes, failures)
