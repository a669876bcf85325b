"""dive.json: how a dive stands, for the process that comes next and for everyone who reads it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from enum import Enum
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.base.storage.whole_folder import is_held

NAME = "dive.json"
FRAMES, METRICS, MAP = "frames.csv", "metrics.json", "map.aqf"
"""Files that every dive has, every finished one, and every finished one with a map: that of its
largest sub-map, where that of another is map_N.aqf."""
CHECKPOINT = "checkpoint"
"""Folder of the checkpoints of a live run."""


class DiveState(str, Enum):
    """What became of a dive."""

    OPEN = "open"
    """It is being mapped, or was when that failed or its process was killed."""
    FINISHING = "finishing"
    """The pilot wants it finished; a process that ends now has left that undone."""
    RESCALING = "rescaling"
    """Its files are being brought to metres, or turned level; if that ends now, they contradict
    each other."""
    STOPPED = "stopped"
    """The service was told to end: the deliverables are there, and the dive may go on."""
    FINISHED = "finished"
    """Nothing comes any more."""

    @property
    def is_complete(self) -> bool:
        """True if the deliverables hold everything."""
        return self in (DiveState.STOPPED, DiveState.FINISHED)


@dataclass(frozen=True)
class DiveStatus:
    """The content of dive.json."""

    state: DiveState
    """What became of the dive."""
    paused: bool = False
    """The pilot wants nothing mapped, until he asks for it."""
    begun_utc: str | None = None
    """When a live dive began; null while the computer's clock had never been set."""
    boot: str = ""
    """Boot of the kernel under which a live dive last ran; empty of a replay."""
    mounting: dict[str, object] | None = None
    """How a live dive's camera sits in the body, if that was stated; else null."""

    @property
    def is_live(self) -> bool:
        """True of a live dive; a replay is of no boot."""
        return bool(self.boot)

    def write(self, dive: Path) -> None:
        """Raises InputError if it cannot be written."""
        write_json(dive / NAME, asdict(self))


def read_status(dive: Path) -> DiveStatus | None:
    """How the dive in this folder stands; None where nothing readable says so."""
    try:
        found = read_regular_json(dive / NAME)
        begun, boot, mounting = (found[name] for name in ("begun_utc", "boot", "mounting"))
        paused = found["paused"] is True
        status = DiveStatus(DiveState(found["state"]), paused, begun, boot, mounting)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    if not isinstance(begun, str | None) or not isinstance(boot, str):
        return None
    if not isinstance(mounting, dict | None):
        return None
    return status


def unfinished_reason(dive: Path) -> str | None:
    """What keeps a dive's files from being those of a finished dive, and what to do about it, in a
    sentence; None of a finished dive, and of a folder that is no dive.

    Without a readable dive.json, as in dives of an older AquaFlow, metrics.json tells: it was the
    last file of a dive, and those that were written while a live dive went on say so.
    """
    status = read_status(dive)
    there = (dive / FRAMES).is_file()
    if status is None:
        return _why_cut_off(dive, live=False) if there and not _has_metrics(dive) else None
    if status.state is DiveState.RESCALING:
        return (
            f"`aquaflow measure scale`, or `level`, was cut off in {dive}, whose files contradict "
            "each other now; map its recording again: "
            f"`aquaflow map RECORDING --out {dive} --overwrite`"
        )
    if not status.state.is_complete:
        return _why_cut_off(dive, status.is_live)
    if there and not (dive / METRICS).is_file():
        return f"nothing of {dive} could be mapped; its {FRAMES} says why, for each frame"
    return None


def _why_cut_off(dive: Path, live: bool) -> str:
    if is_held(dive):
        return f"{dive} is being written by a running aquaflow; wait for its end, or stop it"
    if _has_checkpoint(dive):
        return (
            f"{dive} is not finished: its process was cut off, or the disk was full; "
            f"`aquaflow run finish {dive}` does the rest"
        )
    if live:
        return (
            f"{dive} is not finished: its process was cut off before its first checkpoint, so that "
            "nothing can be added to what was written until then"
        )
    return (
        f"{dive} is not finished: mapping it was cut off, or failed; map its recording again: "
        f"`aquaflow map RECORDING --out {dive}`"
    )


def _has_checkpoint(dive: Path) -> bool:
    return any((dive / CHECKPOINT).glob("*.npz"))


def is_cut_off_replay(dive: Path) -> bool:
    """True where mapping a recording ended before it had a result, so that nothing is lost if it
    begins anew: the recording lies elsewhere. The caller holds the folder's lock."""
    status = read_status(dive)
    if status is None or status.is_live or _has_checkpoint(dive):
        return False
    no_result = status.state.is_complete and not (dive / METRICS).is_file()
    return status.state is DiveState.OPEN or no_result


def refuse_missing(dive: Path) -> None:
    """Raises InputError if there is no such folder."""
    if not dive.is_dir():
        raise InputError(f"there is no folder {dive}; give the folder of a dive")


def refuse_unfinished(dive: Path) -> None:
    """For whoever takes a dive's files as those of a finished one.

    Raises:
        InputError: they are not, or there is no such folder; what happened, and what to do.
    """
    refuse_missing(dive)
    said = unfinished_reason(dive)
    if said is not None:
        raise InputError(said)


def refuse_without_map(dive: Path) -> None:
    """For whoever needs the map of a finished dive.

    Raises:
        InputError: it is not finished, or has no map.
    """
    refuse_unfinished(dive)
    if not (dive / MAP).exists():
        raise InputError(f"{dive} holds no finished dive: {MAP} is missing")


@contextmanager
def rescaling(dive: Path) -> Iterator[None]:
    """The block changes unit or axes of a finished dive's files; if it does not come to its end,
    every reader says so.

    Raises:
        InputError: dive.json cannot be written.
    """
    before = read_status(dive) or DiveStatus(DiveState.FINISHED)
    replace(before, state=DiveState.RESCALING).write(dive)
    yield
    before.write(dive)


def _has_metrics(dive: Path) -> bool:
    """True if metrics.json is there and does not say that it is of a dive that went on."""
    try:
        found = read_regular_json(dive / METRICS)
    except FileNotFoundError:
        return False
    except (OSError, ValueError, RecursionError):  # who reads it says what is wrong with it
        return True
    return not isinstance(found, dict) or found.get("complete") is not False
