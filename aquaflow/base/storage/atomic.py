"""Files that are whole or not there, also after the power was lost: written, appended to, unnamed.

Nothing is written through a link that someone else left in the folder: what is written gets a new
file under a name that nobody can foresee, which then takes the name that was meant, also from a
link. A file of a process that was killed goes when another one writes to the same folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import math
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import yaml

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import LINK, SPECIAL, open_regular

_PART = re.compile(r"\.[0-9a-f]{32}\.part(\.\w+)?")
_CLEARED: set[tuple[int, int]] = set()
"""Device and number of the folders that this process has removed abandoned files from."""


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content becomes ``path`` when the block ends without an exception.

    Raises:
        InputError: the file cannot be written.
    """
    with explain_refusal(path), replacing(path) as stream:
        yield stream
        stream.flush()
        os.fsync(stream.fileno())


@contextlib.contextmanager
def fresh_file(path: Path) -> Iterator[Path]:
    """The name of an empty file, with the ending of ``path``, for a library that opens by name:
    what it holds becomes ``path`` when the block ends without an exception.

    Raises:
        InputError: the file cannot be written.
    """
    with explain_refusal(path), _part(path, path.suffix) as (name, _):
        part = path.with_name(name)
        yield part
        with part.open("rb") as stream:
            os.fsync(stream.fileno())


@contextlib.contextmanager
def scratch_file(path: Path) -> Iterator[Path]:
    """The name of an empty file beside ``path`` with its ending, for a library that opens by name;
    it is gone when the block ends.

    Raises:
        InputError: it cannot be made.
    """
    with explain_refusal(path), _new_part(path, path.suffix) as (_, name, _):
        yield path.with_name(name)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """As :func:`atomic_write`, but what is lost with the power may be lost, and an error of the
    system is raised as it is.

    Raises:
        OSError: the file cannot be written.
    """
    with _part(path) as (_, descriptor), os.fdopen(os.dup(descriptor), "wb") as stream:
        yield stream
        stream.flush()


@contextlib.contextmanager
def explain_refusal(path: Path) -> Iterator[None]:
    """What the system refuses in the block is one sentence about ``path``.

    Raises:
        InputError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror or error}; give a folder with room that can be "
            "written to"
        ) from error


@contextlib.contextmanager
def _part(path: Path, ending: str = "") -> Iterator[tuple[str, int]]:
    """Name and descriptor of a new file beside ``path``, which takes its name in the end; or else
    is removed, and what was at ``path`` stays."""
    with _new_part(path, ending) as (folder, name, descriptor):
        yield name, descriptor
        os.replace(name, path.name, src_dir_fd=folder, dst_dir_fd=folder)


@contextlib.contextmanager
def _new_part(path: Path, ending: str) -> Iterator[tuple[int, str, int]]:
    """Descriptor of the folder of ``path``, name and descriptor of a new file in it, which is
    removed in the end unless it has another name by then."""
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _remove_abandoned(path.parent, folder)
        name, descriptor = _new_file(folder, ending)
        try:
            yield folder, name, descriptor
        finally:
            os.close(descriptor)
            with contextlib.suppress(OSError):
                os.unlink(name, dir_fd=folder)
    finally:
        os.close(folder)


def _new_file(folder: int, ending: str) -> tuple[str, int]:
    """It stays locked as long as its process writes it, which says that it is not abandoned."""
    while True:
        name = f".{secrets.token_hex(16)}.part{ending}"
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(name, flags, 0o666, dir_fd=folder)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return name, descriptor
        os.close(descriptor)  # taken for an abandoned one before it was locked


def is_part(path: Path) -> bool:
    """True of a file that is being written, or was when its process was killed."""
    return _PART.fullmatch(path.name) is not None


def _remove_abandoned(path: Path, folder: int) -> None:
    found = os.fstat(folder)
    if (found.st_dev, found.st_ino) in _CLEARED:
        return
    _CLEARED.add((found.st_dev, found.st_ino))
    names: list[str] = []
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        names = [entry.name for entry in entries if _PART.fullmatch(entry.name)]
    for name in names:
        # An error: it is being written, has its final name by now, or is no file of ours.
        with contextlib.suppress(OSError):
            flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            descriptor = os.open(name, flags, dir_fd=folder)
            with os.fdopen(descriptor, "rb", buffering=0):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(name, dir_fd=folder)


def open_to_append(path: Path) -> io.BufferedWriter:
    """A regular file that is appended to, made where there is none; a link is not followed.

    Raises:
        OSError: it cannot be opened, or is a link or no regular file.
    """
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, LINK, str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, SPECIAL, str(path))
    return os.fdopen(descriptor, "ab")


def make_subfolder(path: Path) -> None:
    """Make the folder ``path`` in a folder that others may have made, unless it is there.

    Raises:
        OSError: it cannot be made, or is a link.
    """
    with contextlib.suppress(FileExistsError):
        path.mkdir()
    if path.is_symlink():
        raise OSError(errno.ELOOP, LINK, str(path))
    if not path.is_dir():
        raise OSError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def write_json(path: Path, data: dict[str, Any]) -> None:
    """A JSON file, whole or not there; a number that is not finite is a mistake, not a result.

    Raises:
        InputError: the file cannot be written.
        ValueError: a number is not finite.
    """
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))


def _plain(value: Any) -> Any:
    """NumPy's numbers, which PyYAML refuses, as Python's; tuples as lists."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return value.item() if hasattr(value, "item") and hasattr(value, "dtype") else value


def write_yaml(path: Path, data: dict[str, Any], comment: str = "") -> None:
    """Write a YAML file atomically, with its keys in the order of ``data``, after a ``comment`` of
    one line.

    Raises:
        InputError: the file cannot be written.
    """
    head = f"# {comment}\n" if comment else ""
    text = head + yaml.safe_dump(_plain(data), sort_keys=False, allow_unicode=False)
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))


# --------------------------------------------------------------------------------------------------
# Arrays in files without a name, for what a command needs while it runs beyond its memory.


def scratch_array(folder: Path, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """An array in a file of ``folder``, which is made if needed; the file ends with the array.

    Its room is taken at once: a disk that fills up later would end the process.

    Raises:
        InputError: the file cannot be made.
    """
    size = max(1, math.prod(shape)) * np.dtype(dtype).itemsize
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as stream:
            os.posix_fallocate(stream.fileno(), 0, size)
            flat: np.memmap[Any, Any] = np.memmap(
                stream, dtype, "r+", shape=(max(1, math.prod(shape)),)
            )
    except OSError as error:
        raise InputError(
            f"cannot write to {folder}: {error.strerror or error}; give a folder with room that "
            "can be written to"
        ) from error
    # As a plain array: each time that a memmap is indexed costs as much as thousands of values.
    return flat[: math.prod(shape)].reshape(shape).view(np.ndarray)


# --------------------------------------------------------------------------------------------------
# Files of lines that are appended to, also after a power cut in the middle of a line.


def is_cut_short(path: Path) -> bool:
    """True if the file's last line has no end."""
    try:
        with open_regular(path) as stream:
            stream.seek(-1, os.SEEK_END)
            return stream.read(1) != b"\n"
    except OSError:  # there is none, or it is empty
        return False
