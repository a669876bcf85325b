"""One live dive from its folder to its report: constructs, runs and closes all parts."""

from __future__ import annotations

import logging
import shutil
import sys
from dataclasses import dataclass
from functools import partial

from aquaflow.config import Config, parse_config
from aquaflow.config.service import ServiceConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.cores import core_count, usable_threads
from aquaflow.dive.folder import CHECKPOINT, DiveFolder
from aquaflow.dive.replay import fix_threads
from aquaflow.dive.run import DiveRun, Finished
from aquaflow.errors import AquaFlowError, NotMappedError
from aquaflow.mapping.maps import Maps, Progress
from aquaflow.messages import Dropped
from aquaflow.profiler import Profiler
from aquaflow.recording.telemetry_lines import NAME as TELEMETRY
from aquaflow.recording.telemetry_lines import TelemetryLog
from aquaflow.render import select_renderer
from aquaflow.service.checkpoint.checkpoint import Checkpointer, restore
from aquaflow.service.checkpoint.resume import Choice
from aquaflow.service.checkpoint.salvage import Salvaged, lost_with_their_files, salvaged
from aquaflow.service.checkpoint.telemetry import hear_again
from aquaflow.service.checkpoint.tracking import refuse_another_size
from aquaflow.service.dive_clock import Continued
from aquaflow.service.feed import Feed
from aquaflow.service.health.degradation import Degradation
from aquaflow.service.health.heartbeats import Heartbeats, Watchdog
from aquaflow.service.health.pressure import PressureReader
from aquaflow.service.health.systemd import Notifier
from aquaflow.service.loop import LiveLoop
from aquaflow.service.map_thread import MapThread
from aquaflow.service.mounting import camera_mounting
from aquaflow.signals import stop_on_signals
from aquaflow.slam import Slam

log = logging.getLogger(__name__)

SWITCH_S = 0.0005
"""Longest that one Python thread keeps the others waiting; with the usual 5 ms tracking, which
gives way at every call of a kernel, would wait for mapping a dozen times a frame."""
FINISHING_S = 300.0
"""Time requested from systemd at the end of a dive: refining, evaluating, the report."""


@dataclass(frozen=True)
class Parts:
    """The parts of a live dive, for the viewer and the report."""

    loop: LiveLoop
    slam: Slam
    run: DiveRun
    maps: MapThread
    checkpointer: Checkpointer
    choice: Choice


class LiveDive:
    """Construct, :meth:`run`, then :meth:`close`, which the context manager does."""

    def __init__(
        self,
        name: str,
        choice: Choice,
        feed: Feed,
        config: VehicleConfig,
        overwrite: bool = False,
    ) -> None:
        """Construct all parts.

        Raises:
            ConfigError: the checkpoint is of pictures of another size.
            UnusableStateError: the dive cannot be resumed from the checkpoint.
            InputError: the folder cannot be used.
        """
        service = config.service
        cores = usable_threads(config.threads)
        fix_threads(max(1, cores // 2))  # tracking's; the renderer's are counted below
        sys.setswitchinterval(SWITCH_S)
        self._plain = plain(config)
        self._salvaged = _salvaged(choice, self._plain, feed)
        rows = None if self._salvaged is None else self._salvaged.rows
        self.folder = DiveFolder(choice.folder, self._plain, overwrite, rows)
        self.feed = feed
        self._heartbeats, self._degradation = Heartbeats(), Degradation(service.limits)
        self._notifier = Notifier()
        self.parts = self._assembled(name, choice, service)
        self._watchdog = Watchdog(self._heartbeats, service.hang_s)
        self._finished = False

    def _assembled(self, name: str, choice: Choice, service: ServiceConfig) -> Parts:
        config, feed, profiler = self._plain, self.feed, Profiler()
        # A core is left for tracking, where there is more than one.
        threads = config.threads or max(1, core_count() - 1)
        renderer = select_renderer(config.mapping.renderer, threads)
        failures = feed.failures
        maps = Maps(config, renderer, profiler, self.folder.work, failures)
        thread = MapThread(maps, service.mapping, self._heartbeats, lambda: self._degradation.level)
        slam = Slam(config, profiler, self.folder.work, True, thread, failures)
        with failures.contain("camera mounting"):
            slam.metric.mounting = camera_mounting(config, service, feed)
        run = DiveRun(name, self.folder, config, slam, feed.calibration, feed.name_of)
        continued = Continued()
        if choice.checkpoint is not None:
            try:
                restore(choice.checkpoint, slam, run, maps)
            except AquaFlowError:
                slam.close(keep=True)
                self.folder.close(keep_work=True)
                raise
            known, rows = choice.checkpoint, self.folder.rows
            continued = Continued.after(known.moment, rows, known.clocks)
            run.notes += lost_with_their_files(known, slam, maps)
            run.dropped += [
                Dropped(row.index, round(row.t_s * 1e9), row.reason)
                for row in rows
                if row.frame_class == "dropped"
            ]
            hear_again(run)
            log.info("resumed %s with %d keyframes", self.folder.path, len(slam.keyframes))
        run.notes += [*choice.notes, *(self._salvaged.losses if self._salvaged else ())]
        for note in run.notes:
            log.warning("%s", note)
        feed.continue_from(continued)
        telemetry_log = partial(TelemetryLog, self.folder.path / TELEMETRY)
        run.telemetry_log = failures.attempt(f"opening {TELEMETRY}", telemetry_log)
        loop = LiveLoop(
            run, feed, thread, service, self._heartbeats, self._degradation,
            PressureReader(self.folder.path), self._notifier,
        )  # fmt: skip
        checkpointer = Checkpointer(
            self.folder.path, run, slam, thread, service.checkpoint.every_s, feed.clocks,
            lambda: feed.continued.known_shift_ns,
        )  # fmt: skip
        loop.watchers.append(
            lambda live: checkpointer.take_if_due(live.pressure.disk_is_full(service.limits))
        )
        return Parts(loop, slam, run, thread, checkpointer, choice)

    def run(self, progress: Progress | None = None) -> Finished | None:
        """Run until the source ends or the dive is stopped; None where nothing could be mapped.

        Raises:
            AquaFlowError: the source or the loop failed; the checkpoint stays.
        """
        parts = self.parts
        with stop_on_signals(parts.loop.stopping):
            parts.loop.run()
        source_ended = not parts.loop.stopping.is_set()
        parts.loop.stop("the recording ended" if source_ended else "stop requested")
        self._notifier.more_time(FINISHING_S)
        contain = parts.slam.failures.contain
        if not source_ended:
            with contain("checkpoint"):
                while parts.slam.tracker.past is not None:  # or none would have these poses
                    parts.loop.take(None)
                parts.checkpointer.take()
        with contain("closing of the source"):
            self.feed.close()
        with contain("service counters"):
            parts.run.live = parts.loop.status()
        try:
            finished = parts.run.finish(self.feed.notes, progress)
        except NotMappedError as error:
            log.warning("%s", error)
            finished = None
        self._finished = source_ended
        return finished

    def close(self) -> None:
        """Release everything; an unfinished dive keeps the files for a resumption."""
        keep = not self._finished
        for close in (
            self._watchdog.close,
            self.feed.close,
            partial(self.parts.slam.close, keep),
            self._remove_checkpoint,
            self.parts.run.close,
            self._notifier.close,
            partial(self.folder.close, keep),  # last: until then failures go to its log
        ):
            with self.parts.slam.failures.contain("closing"):
                close()

    def _remove_checkpoint(self) -> None:
        """A dive whose recording ended needs no checkpoint."""
        if self._finished:
            shutil.rmtree(self.folder.path / CHECKPOINT, ignore_errors=True)

    def __enter__(self) -> LiveDive:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _salvaged(choice: Choice, config: Config, feed: Feed) -> Salvaged | None:
    """The salvaged rows and losses if a dive is resumed, else None."""
    if choice.checkpoint is None:
        return None
    refuse_another_size(choice.folder, choice.checkpoint.facts["tracking"], config)
    return salvaged(choice.checkpoint, choice.folder, feed.name_of)


def plain(vehicle: VehicleConfig) -> Config:
    """The settings of mapping alone, with the service's limit on refining."""
    settings = vehicle.model_dump(include=set(Config.model_fields))
    optimiser = settings["mapping"]["optimiser"]
    if optimiser["refine_seconds"] is None:
        optimiser["refine_seconds"] = vehicle.service.mapping.refine_seconds
    return parse_config(settings, "config")
