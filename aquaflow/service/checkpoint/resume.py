"""Selects the folder of a dive: the unfinished one of an earlier run, or a new one.

A new dive is never written into a folder that holds the rows of another; it gets a new folder.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from aquaflow.config.service import CheckpointConfig
from aquaflow.dive.folder import CHECKPOINT, MARKER, WORK
from aquaflow.dive.frames_csv import header
from aquaflow.errors import InputError
from aquaflow.service.checkpoint.generations import Checkpoint, generations, read_state
from aquaflow.service.moment import Moment

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choice:
    """The folder to write to, and the checkpoint to resume from."""

    folder: Path
    checkpoint: Checkpoint | None = None
    notes: tuple[str, ...] = ()
    """Why it is not the requested folder."""


def choose(dives: Path, config: CheckpointConfig, new: bool, now: Moment) -> Choice:
    """The newest dive in ``dives`` that can be resumed, unless ``new``; else a new folder.

    A dive without a usable checkpoint is left unchanged; a new folder is used.
    """
    for folder in [] if new else _unfinished(dives):
        checkpoint = newest_usable(folder)
        if checkpoint is not None and _is_recent(folder, checkpoint, config, now):
            return Choice(folder, checkpoint)
        break  # an older one was left for this one
    return Choice(_fresh(dives))


def resumed(folder: Path, new: bool) -> Choice:
    """A folder given by name: resumed if possible.

    If not, and with ``new``, the dive goes into the first of ``folder``, ``folder-2``, ... that
    holds no rows of another; on the way, without ``new``, one that can be resumed is.
    """
    taken = holds_rows if new else _was_cut_off
    for place in _numbered(folder):
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
    return (folder / MARKER).is_file() and not holds_rows(folder)


def holds_rows(folder: Path) -> bool:
    """True if the folder holds recorded rows, even damaged ones."""
    frames = folder / MARKER
    recorded = frames.is_file() and frames.stat().st_size > len(header())
    return recorded or (folder / "metrics.json").is_file() or bool(_kept(folder))


def newest_usable(folder: Path) -> Checkpoint | None:
    """The newest checkpoint of a dive that can be read."""
    for path in generations(folder):
        try:
            return read_state(path)
        except InputError as error:
            log.warning("%s", error)
    return None


def tidy(dives: Path, keep: Path) -> None:
    """Remove what finished dives, other than ``keep``, kept for a resumption; not from a dive whose
    checkpoints are damaged, which is left as it is."""
    for report in dives.glob("*/report.html"):
        dive = report.parent
        if dive != keep and (not generations(dive) or newest_usable(dive) is not None):
            for name in (CHECKPOINT, WORK):
                shutil.rmtree(dive / name, ignore_errors=True)


def _was_cut_off(folder: Path) -> bool:
    """True if the folder holds recorded rows of a dive that was not finished."""
    ended = (folder / "metrics.json").is_file() and not _kept(folder)
    return holds_rows(folder) and not ended


def _kept(folder: Path) -> list[Path]:
    """The files that a run kept for a resumption."""
    return [path for name in (CHECKPOINT, WORK) for path in (folder / name).glob("**/*.*")]


def _numbered(folder: Path) -> Iterator[Path]:
    yield folder
    for count in itertools.count(2):
        yield folder.with_name(f"{folder.name}-{count}")


def _unfinished(dives: Path) -> list[Path]:
    """Folders with a checkpoint, the newest first."""
    newest: dict[Path, float] = {}
    for file in dives.glob(f"*/{CHECKPOINT}/*.npz"):
        dive = file.parent.parent
        newest[dive] = max(newest.get(dive, 0.0), file.stat().st_mtime)
    return sorted(newest, key=newest.__getitem__, reverse=True)


def _is_recent(folder: Path, checkpoint: Checkpoint, config: CheckpointConfig, now: Moment) -> bool:
    age_h = checkpoint.moment.age_h(now)
    recent = not config.resume_h or age_h <= config.resume_h
    if not recent:
        log.info("the dive in %s is %.0f h old: a new one begins", folder, age_h)
    return recent


def _fresh(dives: Path) -> Path:
    """Named by the wall clock, which may stand still over a restart."""
    named = dives / time.strftime("dive-%Y%m%d-%H%M%S")
    return next(folder for folder in _numbered(named) if not folder.exists())
