"""Which folder a dive goes into: the unfinished one of before, or a new one."""

from __future__ import annotations

import logging
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from aquaflow.config.service import CheckpointConfig
from aquaflow.dive import CHECKPOINT, MARKER, WORK
from aquaflow.errors import InputError
from aquaflow.service.checkpoint import Checkpoint, read_state, state_file
from aquaflow.service.moment import Moment

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choice:
    """Where to write, and from what to go on."""

    folder: Path
    checkpoint: Checkpoint | None = None


def choose(dives: Path, config: CheckpointConfig, new: bool, now: Moment) -> Choice:
    """The newest dive in ``dives`` that can be resumed, unless ``new``; else a new folder.

    A checkpoint that cannot be used costs itself: the dive begins anew beside it.
    """
    for folder in [] if new else _unfinished(dives):
        checkpoint = _usable(folder, config, now)
        if checkpoint is not None:
            return Choice(folder, checkpoint)
        break  # an older one was left for this one
    return Choice(_fresh(dives))


def resumed(folder: Path, new: bool) -> Choice:
    """A folder that was asked for by name: resumed if it can be.

    Raises:
        InputError: it holds a checkpoint that cannot be used.
    """
    if new or not state_file(folder).is_file():
        return Choice(folder)
    return Choice(folder, read_state(folder))


def is_unfinished(folder: Path) -> bool:
    """True for a dive that was cut off before its first checkpoint: it may be begun anew."""
    begun = (folder / MARKER).is_file()
    return begun and not (folder / "metrics.json").is_file() and not state_file(folder).is_file()


def tidy(dives: Path, keep: Path) -> None:
    """Remove what finished dives, other than ``keep``, kept for a resumption."""
    for report in dives.glob("*/report.html"):
        if report.parent != keep:
            for name in (CHECKPOINT, WORK):
                shutil.rmtree(report.parent / name, ignore_errors=True)


def _unfinished(dives: Path) -> list[Path]:
    """Folders with a checkpoint, the newest first."""
    files = sorted(dives.glob(f"*/{CHECKPOINT}/state.npz"), key=lambda file: file.stat().st_mtime)
    return [file.parent.parent for file in reversed(files)]


def _usable(folder: Path, config: CheckpointConfig, now: Moment) -> Checkpoint | None:
    try:
        checkpoint = read_state(folder)
    except InputError as error:
        log.warning("%s", error)
        return None
    age_h = checkpoint.moment.age_h(now)
    if config.resume_h and age_h > config.resume_h:
        log.info("the dive in %s is %.0f h old: a new one begins", folder, age_h)
        return None
    return checkpoint


def _fresh(dives: Path) -> Path:
    """Named by the wall clock, which may stand still over a restart."""
    name = time.strftime("dive-%Y%m%d-%H%M%S")
    folder, count = dives / name, 1
    while folder.exists():
        count += 1
        folder = dives / f"{name}-{count}"
    return folder
