"""The last two checkpoints of a dive on the disk; the older replaces a newer that is damaged.

``checkpoint/state.npz`` is the newest, ``checkpoint/previous.npz`` the one before. Both are written
whole and hold no pickle. The CRC-32 of every entry is verified before it is used.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aquaflow.base.clocks.device import Learned
from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.archive import (
    UNREADABLE,
    open_archive,
    read_facts_file,
    write_facts_file,
)
from aquaflow.base.storage.atomic import atomic_write, make_subfolder, open_to_append
from aquaflow.base.storage.dive_status import CHECKPOINT
from aquaflow.geometry.arrays import Arrays
from aquaflow.live.clock_reading import ClockReading

STATE, PREVIOUS = "state.npz", "previous.npz"
"""The newest checkpoint, and the one before it."""
FORMAT = 3
"""Version of the checkpoint; raised when older checkpoints can no longer be resumed."""


class OtherFormatError(InputError):
    """A checkpoint of another version of AquaFlow: not damaged, but not usable."""


def state_file(dive: Path) -> Path:
    """Path of a dive's newest checkpoint."""
    return dive / CHECKPOINT / STATE


def previous_file(dive: Path) -> Path:
    """Path of the checkpoint before."""
    return dive / CHECKPOINT / PREVIOUS


def generations(dive: Path) -> list[Path]:
    """The files of its checkpoints, the newest first."""
    return [path for path in (state_file(dive), previous_file(dive)) if path.is_file()]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as it was read."""

    file: Path
    facts: dict[str, Any]
    arrays: Arrays

    @property
    def moment(self) -> ClockReading:
        """When it was taken."""
        return ClockReading(**self.facts["moment"])

    @property
    def clocks(self) -> dict[str, Learned]:
        """Learned clock mappings of the devices."""
        known: dict[str, Learned] = self.facts["clocks"]
        return known

    @property
    def frames(self) -> set[int]:
        """Indices of its finished frames."""
        return {int(index) for index in self.arrays["tracking.frames"]["index"]}

    @property
    def keyframes(self) -> int:
        """Number of its keyframes."""
        return len(self.arrays["tracking.keyframes"])


def write_state(
    dive: Path,
    facts: dict[str, Any],
    arrays: Arrays,  # by name, of any shape
) -> None:
    """Write the newest checkpoint of ``dive``; the newest so far becomes the previous one.

    Raises:
        InputError, OSError: it cannot be written; those that there are stay.
    """
    path = state_file(dive)
    make_subfolder(path.parent)
    fresh = path.with_name("fresh.npz")
    try:
        write_facts_file(fresh, facts, arrays, allow_nan=False)
        if path.is_file():
            _rename_or_link(path, previous_file(dive))
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
    bring_to_disk([path.parent])


def _rename_or_link(path: Path, name: Path) -> None:
    """Let the file have another name, and keep this one until it is replaced, where the file
    system can do that (FAT cannot): at no moment is there no newest checkpoint."""
    link = path.with_name("link.npz")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link, follow_symlinks=False)
        link.replace(name)
    except OSError:
        path.replace(name)
    finally:
        link.unlink(missing_ok=True)  # still there if it was the same file as ``name``


def read_state(path: Path) -> Checkpoint:
    """The checkpoint in the file ``path``.

    Raises:
        OtherFormatError: another version of AquaFlow wrote it.
        InputError: it is not there, or is damaged.
    """
    try:
        with open_archive(path, stored=True, folders=1) as file:
            damaged = file.testzip()
        if damaged is not None:
            raise InputError(f"{path} is damaged: {damaged} differs from its checksum")
        facts, arrays = read_facts_file(path, folders=1)
        checkpoint = Checkpoint(path, facts, arrays)
        known = facts["format"] == FORMAT
        if known:
            _ = checkpoint.moment, checkpoint.clocks, checkpoint.frames, checkpoint.keyframes
    except FileNotFoundError as error:
        raise InputError(f"{path} is not there") from error
    except (*UNREADABLE, *UNEXPECTED) as error:
        raise InputError(f"{path} is damaged: {type(error).__name__}") from error
    if not known:
        raise OtherFormatError(f"{path} was written by version {facts.get('version')}")
    return checkpoint


UNEXPECTED = (NotImplementedError, RuntimeError, MemoryError, OverflowError, AttributeError)
"""Further errors that zipfile raises where bits of its directory are wrong."""


def bring_to_disk(paths: Iterable[Path]) -> None:
    """fsync files that must survive a power cut; missing files are ignored."""
    for path in paths:
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError:
            continue
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# --------------------------------------------------------------------------------------------------
# Sets damaged files of a dive aside: nothing is deleted or mixed with newly written files.
#
# ``set-aside-1/``, ``set-aside-2/``, ... in the dive's folder, one for each start that found
# damage, hold the files under the names that they had in the dive; ``why.txt`` says what is wrong
# with each.

WHY = "why.txt"
"""The file with the reason for each file set aside."""


class SetAside:
    """Makes its folder with the first file."""

    def __init__(self, dive: Path) -> None:
        self._dive = dive
        self._folder: Path | None = None

    def move(self, path: Path, why: str) -> None:
        """Move a file out of the dive.

        Raises:
            InputError: it cannot be moved.
        """
        try:
            path.replace(self._place(path, why))
        except OSError as error:
            raise _refusal(path, error) from error

    def copy(self, path: Path, why: str) -> None:
        """Keep a file as it is now, if it is there: it will be written anew.

        Raises:
            InputError: it cannot be copied.
        """
        if not path.is_file():
            return
        try:
            depth = len(path.relative_to(self._dive).parts) - 1
            with open_regular(path, depth) as stream, atomic_write(self._place(path, why)) as copy:
                shutil.copyfileobj(stream, copy)
        except OSError as error:
            raise _refusal(path, error) from error

    def _place(self, path: Path, why: str) -> Path:
        if self._folder is None:
            count = 1
            while (self._dive / f"set-aside-{count}").exists():
                count += 1
            self._folder = self._dive / f"set-aside-{count}"
        name = path.relative_to(self._dive)
        place = self._folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        with open_to_append(self._folder / WHY) as stream:
            stream.write(f"{name}: {why}\n".encode())
        return place


def _refusal(path: Path, error: OSError) -> InputError:
    reason = error.strerror or str(error)
    return InputError(f"cannot set {path} aside: {reason}; give the dive's folder room and rights")
