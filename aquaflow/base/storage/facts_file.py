"""Arrays and facts in one file: a zip of arrays (``.npz``, uncompressed, without pickle) that has a
JSON text among them.
"""

from __future__ import annotations

import json
import math
import struct
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from aquaflow.base.errors import DamagedError
from aquaflow.base.storage.array_file import Arrays
from aquaflow.base.storage.atomic import atomic_write

FACTS = "facts"
"""Name of the array that holds the facts as JSON."""
MOST_FACTS_BYTES = 1 << 26
"""A camera takes 200 bytes, and no dive has a camera for each of 300,000 views."""
UNREADABLE = (
    *(OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError),
    *(NotImplementedError, RuntimeError, SyntaxError, MemoryError, RecursionError, struct.error),
)
"""What :func:`read_facts_file` raises where a file is missing, damaged, or not an AquaFlow file."""


def write_facts_file(
    path: Path,
    facts: dict[str, Any],
    arrays: Arrays,  # by name, of any shape
    allow_nan: bool = True,
) -> None:
    """Write both, whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: a fact is not finite, and ``allow_nan`` is not set.
    """
    text = json.dumps(facts, allow_nan=allow_nan).encode("utf-8")
    with atomic_write(path) as stream:
        np.savez(stream, allow_pickle=False, **{FACTS: np.frombuffer(text, np.uint8)}, **arrays)


def read_facts_file(path: Path) -> tuple[dict[str, Any], Arrays]:
    """What was written.

    Raises:
        UNREADABLE: one of them.
    """
    _refuse_bombs(path)
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    text = arrays.pop(FACTS).tobytes()
    if len(text) > MOST_FACTS_BYTES:
        raise DamagedError("its facts are longer than a dive's can be")
    facts: dict[str, Any] = json.loads(text)
    return facts, arrays


def _refuse_bombs(path: Path) -> None:
    """A file holds no more than its own size: ours are not compressed, and no array lies twice.

    NumPy makes the memory for an array before it reads it, and would unpack a few kilobytes of
    zeros to as many gigabytes as they claim.
    """
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        size = path.stat().st_size
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise DamagedError("it is compressed, which AquaFlow's files are not")
        if sum(entry.file_size for entry in entries) > size:
            raise DamagedError("it claims more bytes than it has")
        for entry in entries:
            with archive.open(entry) as stream:
                # Read to its end, an entry is compared with its checksum.
                if _claimed_bytes(stream) + stream.tell() != entry.file_size:
                    raise DamagedError("an array claims more or fewer bytes than it has")


def _claimed_bytes(stream: IO[bytes]) -> int:
    """Size of the array whose ``.npy`` header begins here."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    return math.prod(shape) * dtype.itemsize
