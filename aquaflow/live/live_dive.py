"""One live dive from its folder to its report."""

from __future__ import annotations

import logging
import shutil
import sys
from functools import partial

from aquaflow.base.clocks.deadline import FinishTime
from aquaflow.base.errors import NotMappedError
from aquaflow.base.storage.dive_status import CHECKPOINT, DiveState
from aquaflow.base.worker import usable_threads
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.replay import fix_threads
from aquaflow.dive.run import Finished
from aquaflow.live.checkpoint.repair import salvaged_from
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.control import ServiceControl
from aquaflow.live.dive_parts import assemble, plain
from aquaflow.live.feed import Feed
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.state import ServiceState
from aquaflow.live.idle_loop import FINISHING
from aquaflow.mapping.work import Progress

log = logging.getLogger(__name__)

SWITCH_S = 0.0005
"""Longest that one Python thread keeps the others waiting; with the usual 5 ms tracking, which
gives way at every call of a kernel, would wait for mapping a dozen times a frame."""
STAGE = "finishing"
"""Name of a dive's end among the heartbeats; it is hung where it takes ``service.hang_s`` longer
than ``service.finish_s``."""
FINISH_MARGIN_S = 30.0
"""Requested from systemd on top of ``service.finish_s`` or ``service.stop_s``: what cannot be cut
short, and closing."""
CUT_SHORT = (
    "the service was told to stop, and the end of the dive was kept short (service.stop_s); "
    "`aquaflow run finish` refines the map and evaluates more"
)


class LiveDive:
    """Construct, :meth:`run`, then :meth:`close`, which the context manager does."""

    def __init__(
        self,
        name: str,
        choice: Choice,
        feed: Feed,
        config: VehicleConfig,
        overwrite: bool = False,
        vitals: ServiceHealth | None = None,
        control: ServiceControl | None = None,
    ) -> None:
        """Construct all parts; ``vitals`` and ``control`` are the service's, where it has several
        dives.

        Raises:
            ConfigError: the checkpoint is of pictures of another size.
            UnusableStateError: the dive cannot be resumed from the checkpoint.
            InputError: the folder cannot be used.
        """
        cores = usable_threads(config.threads)
        fix_threads(max(1, cores // 2), plain(config))  # tracking's; the renderer has its own
        sys.setswitchinterval(SWITCH_S)
        salvaged = salvaged_from(choice, plain(config), feed.name_of)
        rows = None if salvaged is None else salvaged.rows
        self.folder = DiveFolder(choice.folder, plain(config), overwrite, rows, feed.dive_s)
        self.feed, self.control = feed, control or ServiceControl()
        self.vitals = vitals or ServiceHealth(config.service)
        self._own_vitals = vitals is None
        self._finish_s, self._stop_s = config.service.finish_s, config.service.stop_s
        self._finished = False
        losses = [] if salvaged is None else salvaged.losses
        try:
            self.parts = assemble(
                name, choice, feed, config, self.folder, self.vitals, self.control, losses
            )
        except BaseException:
            self._close_vitals()
            self.folder.close(keep_work=True)
            raise

    def run(self, progress: Progress | None = None) -> Finished | None:
        """:meth:`map`, and then :meth:`finish`."""
        self.map()
        return self.finish(progress)

    def map(self) -> None:
        """Map until the source ends, or the dive shall.

        Raises:
            AquaFlowError: the source or the loop failed; the checkpoint stays.
        """
        self.parts.loop.run()
        self.parts.loop.end()

    def finish(self, progress: Progress | None = None) -> Finished | None:
        """Refine and write, within ``service.finish_s``, and within ``service.stop_s`` once a
        signal came; None where nothing could be mapped. A dive whose service was told to stop can
        be gone on with; every other one is finished.

        Raises:
            InputError: the disk is full.
        """
        parts, heartbeats, told = self.parts, self.vitals.heartbeats, self.control.told.is_set
        limits = FinishTime(self._finish_s, stopped=told, stop_s=self._stop_s)
        parts.refresher.end()
        if self._finish_s is not None:
            heartbeats.beat(STAGE, ahead_s=self._finish_s)
        stopped, contain = self.control.stopping.is_set(), parts.slam.failures.contain
        self._tell(stopped)
        if stopped:
            with contain("checkpoint"):
                parts.loop.catch_up(limits.settling)  # or none would have these poses
                parts.checkpointer.take()
        else:
            parts.standing.set(DiveState.FINISHING)
        with contain("device errors"):
            parts.device_errors.tell()
        if stopped or self.feed.newest.ended:
            with contain("closing of the source"):
                self.feed.close()
        with contain("service counters"):
            parts.run.live = parts.loop.status()
        try:
            notes = [*self.feed.notes, *parts.loop.notes(), *([CUT_SHORT] if told() else [])]
            finished = parts.run.finish(notes, progress, limits)
        except NotMappedError as error:
            log.warning("%s", error)
            finished = None
        self._finished = not stopped
        parts.standing.set(DiveState.STOPPED if stopped else DiveState.FINISHED)
        heartbeats.retire(STAGE)
        return finished

    def _tell(self, stopped: bool) -> None:
        """What happens now: the service ends with this dive, or waits for the next."""
        if stopped or self.feed.newest.ended:
            reason = "stop requested" if stopped else "the recording ended"
            most_s = self._stop_s if self.control.told.is_set() else self._finish_s or 0.0
            self.vitals.stop(reason, most_s + FINISH_MARGIN_S)
        else:
            self.vitals.health.set(ServiceState.FINISHING, FINISHING)
        self.parts.loop.tell_watchers()  # the pilot hears it while the feed is open

    def close(self) -> None:
        """Release everything; an unfinished dive keeps the files for a resumption."""
        keep = not self._finished
        for close in (
            partial(self.parts.slam.close, keep),
            self._remove_checkpoint,
            self.parts.run.close,
            self._close_vitals,
            partial(self.folder.close, keep),  # last: until then failures go to its log
        ):
            with self.parts.slam.failures.contain("closing"):
                close()

    def _close_vitals(self) -> None:
        if self._own_vitals:
            self.vitals.close()

    def _remove_checkpoint(self) -> None:
        """A dive that is finished needs no checkpoint."""
        if self._finished:
            shutil.rmtree(self.folder.path / CHECKPOINT, ignore_errors=True)

    def __enter__(self) -> LiveDive:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
