"""The parts of a live dive, and how they are put together: for a new one, or one that goes on."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial

from aquaflow.base.errors import AquaFlowError
from aquaflow.base.stages import Stages
from aquaflow.base.storage.dive_status import DiveStatus, read_status
from aquaflow.base.worker import Worker, core_count
from aquaflow.config import Config, parse_config
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.run import DiveRun
from aquaflow.live.checkpoint.base import localise_in_base
from aquaflow.live.checkpoint.checkpoint import Checkpointer, restore
from aquaflow.live.checkpoint.generations import Checkpoint
from aquaflow.live.checkpoint.repair import lost_with_their_files
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.checkpoint.telemetry import hear_again
from aquaflow.live.control import ServiceControl
from aquaflow.live.deliverable_updates import DeliverableUpdater
from aquaflow.live.device_errors import DeviceErrors
from aquaflow.live.dive_clock import Continued
from aquaflow.live.dive_status_file import DiveStatusFile
from aquaflow.live.feed import Feed
from aquaflow.live.health.pressure import PressureReader
from aquaflow.live.loop import LiveLoop
from aquaflow.live.map_thread import MapThread
from aquaflow.live.mounting import camera_mounting
from aquaflow.live.service_health import ServiceHealth
from aquaflow.mapping.work import OwnedMaps
from aquaflow.recordings.kept_pictures import PictureThread
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY
from aquaflow.recordings.telemetry_lines import TelemetryWriter
from aquaflow.slam import Slam
from aquaflow.slam.map_inputs import make_maps
from aquaflow.types import Dropped

log = logging.getLogger(__name__)


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
    thread = MapThread(
        maps, service.mapping, vitals.heartbeats, lambda: vitals.degradation.level
    )  # fmt: skip
    worker = Worker(failures, threads=True)
    slam = Slam(config, stages, folder.work, worker, thread)
    slam.prior.warm_up()
    said = localise_in_base(slam, service.dive.site, choice.checkpoint)
    with failures.contain("camera mounting"):
        stated = camera_mounting(config, service, feed)
        slam.metric.mounting = stated or _mounting_of(before)
    run = DiveRun(name, folder, config, slam, feed.calibration, feed.name_of)
    continued = Continued()
    if choice.checkpoint is not None:
        continued = _restore(choice.checkpoint, slam, run, maps)
    run.notes += [*choice.notes, *losses, *said]
    for note in run.notes:
        log.warning("%s", note)
    feed.continue_from(continued)
    failures.attempt(
        "writing calibration.yaml", partial(folder.write_calibration, feed.calibration)
    )
    telemetry_log = partial(TelemetryWriter, folder.path / TELEMETRY)
    run.telemetry_log = failures.attempt(f"opening {TELEMETRY}", telemetry_log)
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

    def write_what_is_due(live: LiveLoop) -> None:
        disk_is_full = live.pressure.disk_is_full(service.limits)
        checkpointer.take_if_due(disk_is_full)
        refresher.write_if_due(disk_is_full)

    def note_pause() -> None:
        checkpointer.take_soon()
        refresher.write_soon()

    standing = DiveStatusFile(folder.path, failures, slam.metric.mounting, before, note_pause)
    errors = DeviceErrors(feed.describe)
    loop.watchers += [standing.update, write_what_is_due, lambda live: errors.update()]
    frames_before = len(slam.frames)
    return Parts(
        loop, slam, run, thread, checkpointer, refresher, choice, standing, errors, frames_before
    )  # fmt: skip


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
