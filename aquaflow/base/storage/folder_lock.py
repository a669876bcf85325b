"""One process writes to a folder: flock(2) on the folder itself, gone with the process."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from aquaflow.base.errors import InputError


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
