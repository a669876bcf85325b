"""The parts of a live dive, and how they are put together: for a new one, or one that goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

from aquaflow.base.errors import AquaFlowError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Stages
from aquaflow.base.storage.dive_status import DiveState, DiveStatus, read_status
from aquaflow.base.worker import Lateness, Worker, core_count
from aquaflow.config import Config, parse_config
from aquaflow.config.service import LimitsConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.run import DiveRun
from aquaflow.live.checkpoint.base import localise_in_base
from aquaflow.live.checkpoint.checkpoint import Checkpointer, restore
from aquaflow.live.checkpoint.generations import Checkpoint
from aquaflow.live.checkpoint.repair import hear_again, lost_with_their_files
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.clock_reading import OLDEST_NS, ClockReading, Continued
from aquaflow.live.control import ServiceControl
from aquaflow.live.deliverable_updates import DeliverableUpdater
from aquaflow.live.feed import Feed, camera_mounting
from aquaflow.live.health.exposition import DROPPED, ERRORS
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.pressure import PressureReader
from aquaflow.live.loop import LiveLoop
from aquaflow.live.map_thread import MapThread
from aquaflow.mapping.work import OwnedMaps
from aquaflow.recordings.kept_pictures import PictureThread
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY
from aquaflow.recordings.telemetry_lines import TelemetryWriter
from aquaflow.slam import Slam, make_maps
from aquaflow.types import Dropped

# --------------------------------------------------------------------------------------------------
# What devices lost or sent in vain, summed up in log.jsonl once a minute.

EVERY_S = 60.0
"""Period of the summaries: a device that fails for an hour takes 60 lines."""

Devices = Mapping[str, Mapping[str, object]]


class DeviceErrors:
    """Compares the counters of the devices with those of the summary before."""

    def __init__(
        self, describe: Callable[[], Devices], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._describe, self._now_s = describe, now_s
        self._before: dict[str, dict[str, int]] = {}
        self._since_s = now_s()

    def update(self) -> None:
        """To be called often; tells what went wrong once a minute."""
        if self._now_s() - self._since_s >= EVERY_S:
            self.tell()

    def tell(self) -> None:
        """A line for each device that counted something since the last."""
        took_s, self._since_s = self._now_s() - self._since_s, self._now_s()
        for name, device in self._describe().items():
            counts = {
                key: value
                for key in (*DROPPED, *ERRORS)
                if isinstance(value := device.get(key), int)
            }
            before, self._before[name] = self._before.get(name, {}), counts
            grown = {key: counts[key] - before.get(key, 0) for key in counts}
            grown = {key: count for key, count in grown.items() if count > 0}
            if grown:
                self._log(name, grown, took_s)

    @staticmethod
    def _log(name: str, grown: dict[str, int], took_s: float) -> None:
        words = ", ".join(f"{count} {key.replace('_', ' ')}" for key, count in grown.items())
        fields = {"event": "errors", "source": name, "counts": grown}
        log.warning("%s: in %.0f s %s", name, took_s, words, extra={"fields": fields})


log = logging.getLogger(__name__)


# --------------------------------------------------------------------------------------------------
# The parts of a live dive.


@dataclass(frozen=True)
class Parts:
    """The parts of a live dive, for the viewer and the report."""

    loop: LiveLoop
    slam: Slam
    run: DiveRun
    maps: MapThread
    checkpointer: Checkpointer
    refresher: DeliverableUpdater
    choice: Choice
    standing: DiveStatusFile
    device_errors: DeviceErrors
    frames_before: int
    """Of an earlier run of the same dive."""


def assemble(
    name: str,
    choice: Choice,
    feed: Feed,
    vehicle: VehicleConfig,
    folder: DiveFolder,
    vitals: ServiceHealth,
    control: ServiceControl,
    losses: list[str],
) -> Parts:
    """All parts of a dive; ``losses``: what damaged files cost one that goes on.

    Raises:
        UnusableStateError: the dive cannot be resumed from the checkpoint.
        ConfigError: the prior cannot give what the config asks tracking for.
    """
    config, service, failures = plain(vehicle), vehicle.service, feed.failures
    stages = Stages(failures=failures)
    before = None if choice.checkpoint is None else read_status(folder.path)
    # A core is left for tracking, where there is more than one.
    threads = config.threads or max(1, core_count() - 1)
    # A dive whose map was made before mapping was switched off keeps it.
    mapped = config.mapping.enabled or _has_maps(choice.checkpoint)
    maps = make_maps(config, stages, folder.work, mapped, threads)
    lateness = Lateness()
    thread = MapThread(
        maps, service.mapping, vitals.heartbeats, lambda: vitals.degradation.level, lateness
    )
    worker = Worker(failures, threads=True, lateness=lateness)
    slam = Slam(config, stages, folder.work, worker, thread)
    slam.prior.warm_up()
    said = localise_in_base(slam, service.dive.site, choice.checkpoint)
    with failures.contain("camera mounting"):
        stated = camera_mounting(config, service, feed)
        slam.metric.mounting = stated or _mounting_of(before)
    run = DiveRun(name, folder, config, slam, feed.calibration, feed.name_of)
    _begin(run, choice, feed, maps, [*choice.notes, *losses, *said])
    vitals.health.begin()
    pressure = PressureReader(folder.path, gpu_free=thread.usable_memory)
    loop = LiveLoop(run, feed, thread, service, vitals, control, pressure)
    if run.pictures is not None:
        run.picture_thread = PictureThread(
            run.pictures, failures, lambda: not loop.pressure.disk_is_full(service.limits)
        )
    checkpointer = Checkpointer(
        folder.path, run, slam, thread, service.checkpoint.every_s, feed.clocks,
        lambda: feed.continued.known_shift_ns,
    )  # fmt: skip
    refresher = DeliverableUpdater(run, thread, service.checkpoint.deliverables_s)
    write_what_is_due, note_pause = _writers(checkpointer, refresher, service.limits)
    standing = DiveStatusFile(folder.path, failures, slam.metric.mounting, before, note_pause)
    errors = DeviceErrors(feed.describe)
    loop.watchers += [standing.update, write_what_is_due, lambda live: errors.update()]
    frames_before = len(slam.frames)
    return Parts(
        loop, slam, run, thread, checkpointer, refresher, choice, standing, errors, frames_before
    )  # fmt: skip


def _writers(
    checkpointer: Checkpointer, refresher: DeliverableUpdater, limits: LimitsConfig
) -> tuple[Callable[[LiveLoop], None], Callable[[], None]]:
    """What writes checkpoint and deliverables after a turn of the loop, and what a pause asks."""

    def write_what_is_due(live: LiveLoop) -> None:
        disk_is_full = live.pressure.disk_is_full(limits)
        checkpointer.take_if_due(disk_is_full)
        refresher.write_if_due(disk_is_full)

    def note_pause() -> None:
        checkpointer.take_soon()
        refresher.write_soon()

    return write_what_is_due, note_pause


def _begin(run: DiveRun, choice: Choice, feed: Feed, maps: OwnedMaps, notes: list[str]) -> None:
    """Bring the run to where its checkpoint has it, with ``notes`` on that, and open its files.

    Raises:
        UnusableStateError: the dive cannot be resumed from the checkpoint.
    """
    continued = Continued()
    if choice.checkpoint is not None:
        continued = _restore(choice.checkpoint, run.slam, run, maps)
    run.notes += notes
    for note in run.notes:
        log.warning("%s", note)
    feed.continue_from(continued)
    folder, failures = run.folder, feed.failures
    failures.attempt(
        "writing calibration.yaml", partial(folder.write_calibration, feed.calibration)
    )
    telemetry_log = partial(TelemetryWriter, folder.path / TELEMETRY)
    run.telemetry_log = failures.attempt(f"opening {TELEMETRY}", telemetry_log)


def _mounting_of(before: DiveStatus | None) -> MountingConfig | None:
    """Of the camera in the body, as an earlier run of the dive was told; None where it was not."""
    stated = None if before is None else before.mounting
    return None if stated is None else MountingConfig.model_validate(stated)


def _has_maps(known: Checkpoint | None) -> bool:
    return known is not None and bool(known.facts["mapping"]["maps"])


def _restore(known: Checkpoint, slam: Slam, run: DiveRun, maps: OwnedMaps) -> Continued:
    """The dive as its checkpoint has it; where its frames and its time go on.

    Raises:
        UnusableStateError: the dive cannot be resumed from it.
    """
    try:
        restore(known, slam, run, maps)
    except AquaFlowError:
        slam.close(keep=True)
        raise
    rows = run.folder.rows
    run.notes += lost_with_their_files(known, slam, maps)
    run.dropped += [
        Dropped(row.index, round(row.t_s * 1e9), row.reason)
        for row in rows
        if row.frame_class == "dropped"
    ]
    hear_again(run)
    log.info("resumed %s with %d keyframes", run.folder.path, len(slam.keyframes))
    return Continued.after(known.moment, rows, known.clocks)


def plain(vehicle: VehicleConfig) -> Config:
    """The settings of mapping alone, with the service's limit on refining."""
    settings = vehicle.model_dump(include=set(Config.model_fields))
    optimiser = settings["mapping"]["optimiser"]
    if optimiser["refine_seconds"] is None:
        optimiser["refine_seconds"] = vehicle.service.mapping.refine_seconds
    return parse_config(settings, "config")


# --------------------------------------------------------------------------------------------------
# How a live dive stands, in its dive.json: written when that changes.


class DiveStatusFile:
    """A watcher of the loop: the pilot pauses the dive, and goes on with it."""

    def __init__(
        self,
        dive: Path,
        failures: Failures,
        mounting: MountingConfig | None,
        before: DiveStatus | None,
        paused: Callable[[], None] = lambda: None,
    ) -> None:
        """``before``: of a dive that goes on; ``paused``: called when the pilot pauses it."""
        self._dive, self._failures, self._paused = dive, failures, paused
        begun_utc = _utc(time.time_ns()) if before is None else before.begun_utc
        stated = None if mounting is None else mounting.model_dump(mode="json")
        self.was_paused = before is not None and before.paused
        """The pilot paused it in a process before."""
        boot = ClockReading.now().boot
        self.status = DiveStatus(DiveState.OPEN, self.was_paused, begun_utc, boot, stated)
        self._write()

    def update(self, loop: LiveLoop) -> None:
        """Called after every turn of the loop."""
        paused = loop.control.paused
        if paused is not self.status.paused:
            self.status = replace(self.status, paused=paused)
            self._write()
            if paused:
                self._paused()

    def set(self, state: DiveState) -> None:
        """The dive stands otherwise from here on."""
        self.status = replace(self.status, state=state)
        self._write()

    def _write(self) -> None:
        with self._failures.contain("writing dive.json", full_disk=True):
            self.status.write(self._dive)


def _utc(wall_ns: int) -> str | None:
    """In ISO 8601; None of a clock that was never set."""
    if wall_ns < OLDEST_NS:
        return None
    moment = datetime.fromtimestamp(wall_ns // 1_000_000_000, timezone.utc)
    return moment.isoformat().replace("+00:00", "Z")
