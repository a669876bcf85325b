"""Selects the folder of a dive: the unfinished one of an earlier run, or a new one.

A new dive is never written into a folder that holds the rows of another; it gets a new folder.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.clocks.wall import clock_is_set
from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import CHECKPOINT, DiveState, read_status
from aquaflow.base.storage.dive_status import NAME as STATUS
from aquaflow.base.storage.whole_folder import is_held
from aquaflow.config.service import CheckpointConfig
from aquaflow.dive.folder import MARKER, WORK
from aquaflow.dive.frames_csv import header
from aquaflow.live.checkpoint.generations import Checkpoint, generations, read_state
from aquaflow.live.clock_reading import ClockReading
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choice:
    """The folder to write to, and the checkpoint to resume from."""

    folder: Path
    checkpoint: Checkpoint | None = None
    notes: tuple[str, ...] = ()
    """Why it is not the requested folder, or not the dive before."""
    left: Path | None = None
    """A dive that somebody may yet go on with, or finish."""


def choose(
    dives: Path,
    config: CheckpointConfig,
    new: bool,
    now: ClockReading,
    is_set: Callable[[], bool] = clock_is_set,
) -> Choice:
    """The newest dive in ``dives`` that can be resumed, unless ``new``; else a new folder.

    A dive without a usable checkpoint, one that is too old, and one whose age is not known are left
    unchanged; a new folder is used. ``is_set``: whether the wall clock can be believed.
    """
    folder = None if new else next(iter(_unfinished_folders(dives, now.boot)), None)
    checkpoint = None if folder is None else newest_usable(folder)
    if folder is None or checkpoint is None:  # an older one was left for this one
        return Choice(_fresh(dives))
    why = _why_left(folder, checkpoint, config.resume_h, now, is_set)
    if why is None:
        return Choice(folder, checkpoint)
    note = f"the unfinished dive in {folder} was left as it is: {why}"
    return Choice(_fresh(dives), notes=(note,), left=folder)


def resume_folder(folder: Path, new: bool) -> Choice:
    """A folder given by name: resumed if possible.

    If not, and with ``new``, the dive goes into the first of ``folder``, ``folder-2``, ... that
    holds no rows of another; on the way, without ``new``, one that can be resumed is.
    """
    taken = holds_rows if new else _was_cut_off
    for place in _numbered_folders(folder):
        checkpoint = None if new else newest_usable(place)
        if checkpoint is not None or not taken(place):
            break
    if place == folder:
        return Choice(place, checkpoint)
    why = "another dive" if new else "a dive without a usable checkpoint"
    note = f"{folder} holds {why} and is left as it is: this dive is in {place}"
    log.warning("%s", note)
    return Choice(place, checkpoint, (note,))


def is_begun(folder: Path) -> bool:
    """True for a dive that was interrupted before its first row: it may be restarted."""
    begun = any((folder / name).is_file() for name in (MARKER, STATUS))
    return begun and not holds_rows(folder)


def holds_rows(folder: Path) -> bool:
    """True if the folder holds recorded rows, even damaged ones."""
    frames = folder / MARKER
    recorded = frames.is_file() and frames.stat().st_size > len(header())
    return recorded or (folder / "metrics.json").is_file() or bool(_kept_files(folder))


def newest_usable(folder: Path) -> Checkpoint | None:
    """The newest checkpoint of a dive that can be read."""
    for path in generations(folder):
        try:
            return read_state(path)
        except InputError as error:
            log.warning("%s", error)
    return None


def tidy(dives: Path, keep: Choice) -> None:
    """Remove what complete dives kept for a resumption. Left as they are: the chosen one, the one
    that was left for it, and those whose checkpoints are damaged."""
    for dive in (file.parent for file in dives.glob(f"*/{STATUS}")):
        spared = dive in (keep.folder, keep.left) or not _is_complete(dive)
        if not spared and (not generations(dive) or newest_usable(dive) is not None):
            for name in (CHECKPOINT, WORK):
                shutil.rmtree(dive / name, ignore_errors=True)


def _is_complete(dive: Path) -> bool:
    """True if its deliverables hold everything that came."""
    status = read_status(dive)
    return status is not None and status.state.is_complete


def _was_cut_off(folder: Path) -> bool:
    """True if the folder holds recorded rows of a dive that was not finished."""
    replayed = not (folder / STATUS).exists() and (folder / "metrics.json").is_file()
    ended = (replayed or _is_complete(folder)) and not _kept_files(folder)
    return holds_rows(folder) and not ended


def _kept_files(folder: Path) -> list[Path]:
    """The files that a run kept for a resumption."""
    return [path for name in (CHECKPOINT, WORK) for path in (folder / name).glob("**/*.*")]


def _numbered_folders(folder: Path) -> Iterator[Path]:
    yield folder
    for count in itertools.count(2):
        yield folder.with_name(f"{folder.name}-{count}")


def _unfinished_folders(dives: Path, boot: str) -> list[Path]:
    """Folders with a checkpoint that no process holds. Those that ran under this ``boot`` come
    first, whatever the wall clock was when they did; then the newest."""
    newest: dict[Path, tuple[bool, float]] = {}
    for file in dives.glob(f"*/{CHECKPOINT}/*.npz"):
        dive = file.parent.parent
        status = read_status(dive)
        if status is None or status.state is not DiveState.FINISHED:
            of_this_boot = status is not None and status.boot == boot
            _, written = newest.get(dive, (of_this_boot, 0.0))
            newest[dive] = of_this_boot, max(written, file.stat().st_mtime)
    return [
        dive for dive in sorted(newest, key=newest.__getitem__, reverse=True) if not is_held(dive)
    ]


def _why_left(
    folder: Path,
    checkpoint: Checkpoint,
    resume_h: float,
    now: ClockReading,
    is_set: Callable[[], bool],
) -> str | None:
    """Why an unfinished dive is not gone on with, as a clause; None: it is."""
    status = read_status(folder)
    if status is not None and status.state is DiveState.FINISHING:
        return f"it was being finished; `aquaflow run finish {folder}` does the rest"
    age = age_of(folder, checkpoint.moment, now, is_set)
    if not resume_h or (age.hours is not None and age.hours <= resume_h):
        return None
    if age.hours is not None:
        return f"it is {age.hours:.0f} h old"
    return (
        f"how old it is cannot be known, because {age.unknown}; "
        f"`aquaflow run --out {folder}` goes on with it"
    )


def _fresh(dives: Path) -> Path:
    """Named by the wall clock, which may stand still over a restart."""
    named = dives / time.strftime("dive-%Y%m%d-%H%M%S")
    return next(folder for folder in _numbered_folders(named) if not folder.exists())


# --------------------------------------------------------------------------------------------------
# How long ago a dive was cut off: by a clock that ran on, or by one that was set since.
#
# The wall clock of a board without a battery goes on where it stood when the machine was switched
# off, until a time server is heard: by such a clock yesterday's dive ended a minute ago.

NS_PER_H = 3.6e12
WRITTEN = (MARKER, TELEMETRY, f"{CHECKPOINT}/*.npz")
"""Files that a dive writes all the time."""


@dataclass(frozen=True)
class Age:
    """Hours since a dive's last sign of life; None where no clock tells."""

    hours: float | None
    unknown: str = ""
    """Why it is not known, as a clause."""


def age_of(
    dive: Path, taken: ClockReading, now: ClockReading, is_set: Callable[[], bool] = clock_is_set
) -> Age:
    """The age of ``dive``, whose newest checkpoint was ``taken`` then.

    Within one boot the monotonic clock tells. After another one the wall clock does, from the
    newest time that the dive's files bear, if it ``is_set`` and not behind that time.
    """
    if taken.is_of_the_boot_of(now):
        return Age((now.monotonic_ns - taken.monotonic_ns) / NS_PER_H)
    newest_ns = max([taken.wall_ns, *_written_ns(dive)])
    if now.wall_ns < newest_ns:
        return Age(None, "the computer's clock is behind the dive's files")
    if not is_set():
        return Age(None, "nothing has set the computer's clock since it was started")
    return Age((now.wall_ns - newest_ns) / NS_PER_H)


def _written_ns(dive: Path) -> list[int]:
    found = (path for name in WRITTEN for path in dive.glob(name))
    return [path.stat().st_mtime_ns for path in found]
