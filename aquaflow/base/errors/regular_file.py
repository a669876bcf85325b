"""Files of a folder that others may have made: only regular files that lie inside it are opened.

A link in such a folder may lead to any file of the reader's, and a FIFO or a device may block for
ever. The folder itself is named by the user, who may name a link. Hard links are files like others.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from aquaflow.base.errors import DamagedError

LINK = "it is a link, which is not followed in a folder that others may have made"
SPECIAL = "it is no regular file"
LARGEST_BYTES = 1 << 27
"""Of a table or picture that is read whole: a frames.csv has 100 bytes for each frame."""
LARGEST_JSON_BYTES = 1 << 23
"""Parsed, JSON takes up to 25 times its bytes; the longest that AquaFlow writes have some 100 kB
for each hour of a dive."""
_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def open_regular(path: Path, folders: int = 0, most_bytes: int | None = None) -> BinaryIO:
    """The regular file ``path``, to be read.

    Args:
        folders: how many of the folders that hold it belong to the folder from others: 1 for
            ``DIVE/pictures/000000.jpg``, of which neither picture nor pictures may be a link.
        most_bytes: a longer file is refused.

    Raises:
        OSError: it cannot be opened, is a link or no regular file, or is too long; ``strerror``
            says so in words.
    """
    where = os.open(path.parents[folders], _FOLDER)
    try:
        for name in path.parts[-1 - folders : -1]:
            _refuse(path, name, where, stat.S_ISDIR)
            inside = os.open(name, _FOLDER | os.O_NOFOLLOW, dir_fd=where)
            os.close(where)
            where = inside
        _refuse(path, path.name, where, stat.S_ISREG)
        descriptor = os.open(path.name, _FILE, dir_fd=where)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        os.close(where)
    stream = os.fdopen(descriptor, "rb")
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode):
        stream.close()
        raise OSError(errno.EINVAL, SPECIAL, str(path))
    if most_bytes is not None and found.st_size > most_bytes:
        stream.close()
        raise OSError(errno.EOVERFLOW, f"it has more than {most_bytes >> 20} MB", str(path))
    return stream


def open_regular_text(path: Path, folders: int = 0, errors: str = "strict") -> TextIO:
    """The same, as UTF-8 with its line ends as they are.

    Raises:
        OSError: as :func:`open_regular`.
    """
    stream = open_regular(path, folders, LARGEST_BYTES)
    return io.TextIOWrapper(stream, encoding="utf-8", errors=errors, newline="")


def read_regular(path: Path, folders: int = 0, most_bytes: int = LARGEST_BYTES) -> bytes:
    """All bytes of the regular file ``path``.

    Raises:
        OSError: as :func:`open_regular`.
    """
    with open_regular(path, folders, most_bytes) as stream:
        return stream.read(most_bytes)


def read_regular_json(path: Path, folders: int = 0, most_bytes: int = LARGEST_JSON_BYTES) -> Any:
    """What the JSON in the regular file ``path`` says.

    Raises:
        OSError: as :func:`open_regular`.
        ValueError: it is not JSON, or its lists lie too deep inside each other.
    """
    try:
        return json.loads(read_regular(path, folders, most_bytes))
    except RecursionError as error:
        raise DamagedError("its lists lie too deep inside each other") from error


def sha256_regular(path: Path) -> str:
    """SHA-256 of the regular file ``path``, in hexadecimal digits.

    Raises:
        OSError: as :func:`open_regular`.
    """
    digest = hashlib.sha256()
    with open_regular(path) as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def refuse_linked_folders(root: Path) -> None:
    """Check, before anything is written into it, that no folder inside ``root`` is a link.

    A link instead of a file does no harm: what is written replaces it.

    Raises:
        OSError: one is.
    """
    for folder, names, _ in os.walk(root):
        for name in names:
            if os.path.islink(path := os.path.join(folder, name)):
                raise OSError(errno.ELOOP, LINK, path)


def _refuse(path: Path, name: str, folder: int, wanted: Any) -> None:
    """Before it is opened: to open a device may already do something."""
    mode = os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode
    if stat.S_ISLNK(mode):
        raise OSError(errno.ELOOP, LINK, str(path))
    if not wanted(mode):
        raise OSError(errno.EINVAL, SPECIAL, str(path))
