"""Bounds the memory of a long dive: the items used last stay in memory, the others in files.

An item is read back bit for bit, so a map does not depend on which items were in memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import logging
import os
import shutil
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.archive import Arrays, read_arrays, write_arrays
from aquaflow.base.storage.atomic import open_to_append

log = logging.getLogger(__name__)

T = TypeVar("T")

RESERVE_BYTES = 1 << 30
"""Left free on the disk: the maps of all sub-maps, the report and the log must still find room."""

RELEASE_EVERY = 32
"""Items released between two calls of ``malloc_trim`` (about 4 ms). Without it glibc keeps the free
blocks between items in use: measured at 480 x 270 px with 281 MB of pixels in use, 157 MB of free
blocks after 200 keyframes and 390 MB after 500; with it, under 10 MB."""

SUFFIX = ".arrays"
"""Suffix of the items' files."""

REMOVED = "let_go.txt"
"""File in the same folder: a line for every number whose file was removed on purpose."""

release_memory = getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)
"""``malloc_trim``, which only glibc has and only glibc needs."""


class Spill(Generic[T]):
    """Numbered items: the ``resident`` most recently used are in memory, the others in files.

    To change an item, set it again; only the pinned item, which stays in memory in addition, may
    be changed in place. Without a folder all items stay in memory. For one thread at a time.
    """

    def __init__(
        self,
        folder: Path | None,
        resident: int,
        pack: Callable[[T], Arrays],
        unpack: Callable[[int, Arrays], T],
    ) -> None:
        """``pack`` names an item's arrays without copying; ``unpack`` gets the number as well."""
        self._folder, self._limit = folder, resident
        self._pack, self._unpack = pack, unpack
        self._resident: OrderedDict[int, T] = OrderedDict()
        """Least recently used first."""
        self._unsaved: set[int] = set()
        """Resident items whose file is missing or out of date."""
        self._saved: set[int] = set()
        self._pinned: int | None = None
        self._released = 0
        self._full = False

    def __setitem__(self, number: int, item: T) -> None:
        self._unsaved.add(number)
        self._use(number, item)

    def __getitem__(self, number: int) -> T:
        """The item, read from its file if it is not in memory.

        Raises:
            KeyError: it was never set.
            InputError: its file is gone or damaged.
        """
        if number in self._resident:
            self._resident.move_to_end(number)
            return self._resident[number]
        if number not in self._saved:
            raise KeyError(number)
        item = self._unpack(number, read_item(self._file(number)))
        self._use(number, item)
        return item

    def __delitem__(self, number: int) -> None:
        """Remove an item that is not pinned, and its file."""
        self._unsaved.discard(number)
        if number in self._resident:
            self._release(number)
        if number in self._saved:
            self._saved.discard(number)
            self._note_removed(number)
            with contextlib.suppress(OSError):
                self._file(number).unlink(missing_ok=True)

    def _note_removed(self, number: int) -> None:
        assert self._folder is not None
        with contextlib.suppress(OSError), open_to_append(self._folder / REMOVED) as stream:
            stream.write(f"{number}\n".encode())

    def __contains__(self, number: int) -> bool:
        return number in self._resident or number in self._saved

    def pin(self, number: int) -> None:
        """Keep this one in memory, where it may be changed in place, until another is pinned."""
        item = self[number]
        self._pinned = number
        self._unsaved.add(number)
        self._use(number, item)

    @property
    def in_memory(self) -> list[T]:
        """The items that need not be read from a file."""
        return list(self._resident.values())

    @property
    def resident_bytes(self) -> int:
        """Size of the arrays in memory."""
        items = self._resident.values()
        return sum(array.nbytes for item in items for array in self._pack(item).values())

    def save(self) -> list[Path]:
        """Write what is only in memory, where it stays too; the files that are new.

        Raises:
            OSError: something could not be written.
        """
        if self._folder is None:
            return []
        self._full = False  # there may be room again
        saved = [number for number in sorted(self._unsaved) if self._save(number, self._folder)]
        if self._pinned is not None:
            self._unsaved.add(self._pinned)  # it may be changed in place from here on
        if self._full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._folder))
        return [self._file(number) for number in saved]

    def restore(self, number: int) -> bool:
        """Make an item available that an earlier run saved in the same folder; it is read when it
        is first used. False if it has no file."""
        found = self._folder is not None and self._file(number).is_file()
        if found:
            self._saved.add(number)
        return found

    def removed_numbers(self) -> set[int]:
        """Numbers whose files this run or an earlier one removed; without a file, any other one
        was lost."""
        if self._folder is None:
            return set()
        try:
            lines = read_regular(self._folder / REMOVED, folders=1).split()
        except OSError:
            return set()
        return {int(line) for line in lines if line.isdigit()}

    def close(self, keep: bool = False) -> None:
        """Remove the files; or, to ``keep`` them, write what is only in memory too."""
        if self._folder is None:
            return
        if keep:
            self._full = False
            for number in sorted(self._unsaved):
                self._save(number, self._folder)
            return
        with contextlib.suppress(OSError):
            for number in self._saved:
                self._file(number).unlink(missing_ok=True)
            (self._folder / REMOVED).unlink(missing_ok=True)
            self._folder.rmdir()

    def _use(self, number: int, item: T) -> None:
        self._resident[number] = item
        self._resident.move_to_end(number)
        if self._folder is not None:
            self._make_room(self._folder)

    def _make_room(self, folder: Path) -> None:
        """Release the least recently used items; an item that cannot be written stays."""
        surplus = len(self._resident) - self._limit - (self._pinned is not None)
        if surplus <= 0:
            return
        for number in [number for number in self._resident if number != self._pinned]:
            if surplus == 0:
                return
            if number not in self._unsaved or self._save(number, folder):
                self._release(number)
                surplus -= 1

    def _release(self, number: int) -> None:
        del self._resident[number]
        self._released += 1
        if self._released % RELEASE_EVERY == 0:
            release_memory(0)

    def _save(self, number: int, folder: Path) -> bool:
        """True once the item is in its file. A failure is logged; the next try is the next call of
        :meth:`save` or :meth:`close`."""
        if self._full:
            return False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if shutil.disk_usage(folder).free < RESERVE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            path = self._file(number)
            write_arrays(path, self._pack(self._resident[number]), _owner(path))
        except OSError as error:
            self._full = True
            log.warning(
                "cannot write to %s (%s): new items stay in memory, which a long dive may fill; "
                "give it a folder with room",
                folder,
                error.strerror or error,
            )
            return False
        self._unsaved.discard(number)
        self._saved.add(number)
        return True

    def _file(self, number: int) -> Path:
        assert self._folder is not None
        return self._folder / f"{number:06d}{SUFFIX}"


def read_item(path: Path) -> Arrays:
    """The arrays of a file in a spill's folder.

    Raises:
        InputError: it is damaged, or its name is not the one it was written under.
    """
    return read_arrays(path, _owner(path))


def _owner(path: Path) -> str:
    """Folder and number, which each file contains so that a misplaced file is detected."""
    return f"{path.parent.name}/{path.stem}"
