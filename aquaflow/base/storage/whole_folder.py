"""Folders that are whole or not there, and that one process writes to at a time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write, explain_refusal, make_subfolder

WORK = ".work"
"""Suffix of the hidden folder that a folder is made in."""
MARK = "UNFINISHED.txt"
"""In a folder that holds other files too, while ours are moved into it."""
MARKED = (
    "aquaflow was cut off while it moved files into this folder: some of them may be missing, or "
    "of an earlier time. Give the same command again; this file goes when all of them are there.\n"
)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty folder whose files are in ``path`` when the block ends without an exception, all of
    them: an earlier ``path`` stays as it was until then. What a killed process left is removed.

    A ``path`` that holds files keeps those that have other names. While ours are moved into it,
    which is the only time in which it could be cut off, ``UNFINISHED.txt`` stands there.

    Raises:
        InputError: it cannot be written.
    """
    path = path.resolve()
    if path.exists() and not path.is_dir():
        raise InputError(f"{path} is no folder; give a folder to write to")
    remove_abandoned(path.parent, path.name)
    with working_folder(path.parent, path.name) as work, explain_refusal(path):
        made = work / path.name
        made.mkdir()
        yield made
        _publish(made, path)


@contextmanager
def whole_files(path: Path) -> Iterator[Path]:
    """As :func:`whole_folder`, of files that shall lie beside ``path``, one of them: in a folder
    that keeps its others.

    Raises:
        InputError: they cannot be written.
    """
    path = path.resolve()
    remove_abandoned(path.parent, path.name)
    with working_folder(path.parent, path.name) as work, explain_refusal(path):
        yield work
        _publish(work, path.parent)


def _publish(made: Path, path: Path) -> None:
    try:
        made.rename(path)  # to where there is nothing, or an empty folder
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        with atomic_write(path / MARK) as stream:
            stream.write(MARKED.encode("utf-8"))
        for file in sorted(made.rglob("*")):
            target = path / file.relative_to(made)
            if file.is_dir():
                make_subfolder(target)
            else:
                file.replace(target)
        (path / MARK).unlink()


@contextmanager
def working_folder(parent: Path, name: str) -> Iterator[Path]:
    """A new hidden folder that no other process uses; it is gone afterwards.

    Raises:
        InputError: it cannot be made.
    """
    folder = parent / f".{name}.{uuid.uuid4().hex[:8]}{WORK}"
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"cannot make {parent / name}: {error.strerror}; give a folder that can be written to "
            "as --out"
        ) from error
    lock = FolderLock(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.release()


def remove_abandoned(parent: Path, name: str = "") -> None:
    """Remove the working folders of ``name``, or of all names, whose process was killed; those of
    running ones stay."""
    for folder in parent.glob(f".*{WORK}"):
        of_name = not name or folder.name.rpartition(".")[0].rpartition(".")[0] == f".{name}"
        if of_name and folder.is_dir() and not is_held(folder):
            shutil.rmtree(folder, ignore_errors=True)


# --------------------------------------------------------------------------------------------------
# One process writes to a folder: flock(2) on the folder itself, gone with the process.


class FolderLock:
    """Held from its making until ``release``, or until the process ends however it ends.

    On a file system without locks nothing is held, and nothing refused.
    """

    def __init__(self, folder: Path) -> None:
        """Raises InputError if another process holds ``folder``, or it cannot be opened."""
        try:
            self._descriptor: int | None = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise InputError(f"cannot open the folder {folder}: {error.strerror}") from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.release()
            raise InputError(
                f"{folder} is held by a running aquaflow, which writes to it; stop that one first"
            ) from error
        except OSError:
            self.release()

    def release(self) -> None:
        """Let others have the folder; may be called again."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def refuse_held(folder: Path) -> None:
    """Raises InputError if a process holds ``folder``, before anything of it is touched."""
    FolderLock(folder).release()


def is_held(folder: Path) -> bool:
    """True if a process, this one included, holds ``folder``."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
    return False
