"""``aquaflow run finish``: the end of a live dive whose process was killed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from aquaflow.base.clocks.device import Learned
from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.dive_status import (
    CHECKPOINT,
    DiveState,
    read_status,
    refuse_missing,
    refuse_unfinished,
)
from aquaflow.base.storage.whole_folder import refuse_held
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.folder import MARKER, WORK
from aquaflow.dive.frames_csv import readable_rows
from aquaflow.dive.run import Finished
from aquaflow.geometry.camera import CameraModel
from aquaflow.live.checkpoint.generations import generations
from aquaflow.live.checkpoint.resume import Choice, newest_usable
from aquaflow.live.clock_reading import Continued
from aquaflow.live.feed import LatestSamples
from aquaflow.live.live_dive import LiveDive
from aquaflow.mapping.work import Progress
from aquaflow.sources.newest import Newest
from aquaflow.sources.outbound import OutboundMessage
from aquaflow.types import Dropped, Frame

LEAST_S = 1e-3
"""Of refining; what is asked for may be none."""


class FinishedAlreadyError(InputError):
    """A dive that has nothing left to be done."""


def finish_dive(
    dive: Path, seconds: float | None = None, progress: Progress | None = None
) -> Finished | None:
    """Go on with a dive from its checkpoint to its end: refine, evaluate, write all files, and mark
    it as finished. None where nothing of it could be mapped.

    Args:
        seconds: of refining; None: as the dive's config has it.

    Raises:
        FinishedAlreadyError: there is nothing to be done.
        InputError: it is no dive, a running service writes to it, or no checkpoint can be read.
    """
    refuse_unfit(dive)
    checkpoint = newest_usable(dive)
    if checkpoint is None:
        raise InputError(
            f"{dive} has no checkpoint that can be read, so that nothing can be added to it; what "
            "was written while it went on is there"
        )
    with LiveDive(
        dive.name, Choice(dive, checkpoint), NoFeed(dive), settings_of(dive, seconds)
    ) as live:
        return live.finish(progress)


def refuse_unfit(dive: Path) -> None:
    """Check that a dive can be finished.

    Raises:
        FinishedAlreadyError: it is; what its last process had no time to remove is removed.
        InputError: it is no dive, a running service writes to it, or it is a replay.
    """
    refuse_missing(dive)
    if not (dive / MARKER).is_file():
        raise InputError(f"{dive} is no dive: it has no {MARKER}; give the folder of a dive")
    refuse_held(dive)
    status = read_status(dive)
    replayed = status is None and (dive / "metrics.json").is_file() and not generations(dive)
    if replayed or (status is not None and status.state is DiveState.FINISHED):
        for name in (CHECKPOINT, WORK):
            shutil.rmtree(dive / name, ignore_errors=True)
        raise FinishedAlreadyError(f"{dive} is finished already")
    if status is not None and not status.is_live and not generations(dive):
        refuse_unfinished(dive)


def settings_of(dive: Path, seconds: float | None) -> VehicleConfig:
    """The settings with which the dive was mapped, without any limit on its end but refining's.

    Raises:
        InputError, ConfigError: its config.yaml cannot be read.
    """
    settings = Dive(dive).config.model_dump()
    if seconds is not None:
        settings["mapping"]["optimiser"]["refine_seconds"] = max(seconds, LEAST_S)
    service = VehicleConfig().service.model_dump() | {"finish_s": None}
    return VehicleConfig.model_validate(settings | {"service": service})


class NoFeed:
    """The feed of a dive to which nothing comes any more."""

    lasting = False
    pilot = None

    def __init__(self, dive: Path) -> None:
        """Raises InputError or ConfigError if the dive's calibration cannot be read."""
        self.newest: Newest[Frame | Dropped] = Newest()
        self.newest.end()
        self.latest_samples, self.failures = LatestSamples(), Failures()
        self.notes: list[str] = []
        self.failure: str | None = None
        self.continued = Continued()
        self._calibration = Dive(dive).calibration
        rows, _ = readable_rows(dive / MARKER)
        self._names = {row.index: row.source for row in rows}

    @property
    def calibration(self) -> CameraModel | None:
        return self._calibration

    def name_of(self, index: int) -> str:
        """Source name as the dive's rows have it; raises LookupError for a frame that is not among
        them."""
        return self._names[index]

    def describe(self) -> dict[str, dict[str, object]]:
        return {}

    def dive_s(self) -> float | None:
        return None

    def continue_from(self, continued: Continued) -> None:
        self.continued = continued

    def take(self, timeout_s: float) -> Frame | Dropped | None:
        return self.newest.take(timeout_s)

    def forget(self) -> None:
        self.latest_samples.forget()

    def stated_mounting(self) -> MountingConfig | None:
        return None

    def clocks(self) -> Mapping[str, Learned]:
        return {}

    def send(self, message: OutboundMessage) -> bool:
        return False

    def start(self) -> None: ...

    def close(self) -> None: ...
