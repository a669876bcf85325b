"""Files that others may have made: only regular ones inside their folder are opened, YAML is plain.

A link in such a folder may lead to any file of the reader's, and a FIFO or a device may block for
ever. The folder itself is named by the user, who may name a link. Hard links are files like others.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import yaml

from aquaflow.base.errors import ConfigError, DamagedError, InputError, path_of_key, reason_of

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
    with open_regular(path) as stream:
        return sha256_of_stream(stream)


def sha256_of_stream(stream: BinaryIO) -> str:
    """SHA-256 of what is left in ``stream``, however long, in hexadecimal digits."""
    digest = hashlib.sha256()
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


# --------------------------------------------------------------------------------------------------
# YAML from untrusted files: small, plain, finite, or refused in one sentence.
#
# Every YAML file that AquaFlow reads comes through here. PyYAML's safe loader makes no objects of
# foreign classes, but it follows a document that contains itself, a number of any length, and
# aliases that multiply; validating or printing such a file ends in a traceback or never.

MOST_BYTES = 1 << 20
"""The longest config that ships has 4 kB; PyYAML reads some 100 kB a second."""
DIRECTIVE = "%YAML"
"""How the YAML of OpenCV's FileStorage begins, in a form that PyYAML refuses."""
MOST_DEPTH = 32
"""Mappings and lists inside each other; the deepest setting lies in 6."""
MOST_VALUES = 100_000
"""Counted as often as aliases repeat them."""
MOST_INTEGER = 1 << 63
"""Seeds and times in nanoseconds have 64 bits."""


def read_mapping(path: Path, what: str, hint: str, inside: bool = False) -> dict[str, Any]:
    """The mapping that a YAML file holds; empty for an empty file.

    ``what`` it is and a ``hint`` what to give instead stand in the sentences. ``inside``: the file
    lies in a folder that others may have made, see :mod:`aquaflow.base.errors.regular_file`.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: it holds something else than plain, finite ``key: value`` pairs.
    """
    try:
        with open_regular(path) if inside else path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ConfigError(f"{path} is longer than {MOST_BYTES >> 20} MB; {hint}")
        text = data.decode("utf-8")
        if text.startswith(DIRECTIVE):  # its FileStorage writes a head and a tag that YAML has not
            text = text.partition("\n")[2].replace("!!opencv-matrix", "")
        value = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the {what} {path}: {reason_of(error)}; {hint}") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} is not YAML that can be read ({reason_of(error)}); {hint}") from (
            error
        )
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ConfigError(f"{path} holds no key: value pairs; {hint}")
    problem = next(_problems(value), None)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}; {hint}")
    return value


def _problems(root: dict[Any, Any]) -> Iterator[str]:
    """What is not plain and finite, as words that follow the file's name; stops at any depth."""
    waiting: list[tuple[tuple[str, ...], Any]] = [((), root)]
    count = 0
    while waiting:
        keys, value = waiting.pop()
        count += len(value) if isinstance(value, (dict, list)) else 0
        if count > MOST_VALUES:
            yield f"it has more than {MOST_VALUES} values"
            return
        if len(keys) > MOST_DEPTH:
            yield f"'{path_of_key(keys[:1])}' has more than {MOST_DEPTH} levels, or contains itself"
            return
        if isinstance(value, dict):
            if not all(isinstance(key, str) for key in value):
                yield f"a key{_under(keys)} is not text"
                return
            waiting += [((*keys, key), each) for key, each in value.items()]
        elif isinstance(value, list):
            waiting += [((*keys, str(i)), each) for i, each in enumerate(value)]
        elif (said := _unusable(value)) is not None:
            yield f"'{path_of_key(keys)}' {said}"


def _under(keys: tuple[str, ...]) -> str:
    return f" under '{path_of_key(keys)}'" if keys else ""


def _unusable(value: Any) -> str | None:
    """Why a value can be no setting; None if it can."""
    if isinstance(value, int):
        return None if abs(value) <= MOST_INTEGER else "is too large a number"
    if isinstance(value, float):
        return None if math.isfinite(value) else "is not a finite number"
    if isinstance(value, str):
        return None if value.isascii() or _is_unicode(value) else "is not Unicode text"
    return None if value is None else "is neither text nor a number; put it into quotes"


def _is_unicode(text: str) -> bool:
    """False for half of a surrogate pair, which no file name and no terminal takes."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
