"""Zip archives, of arrays or of other members, from a folder that others may have made.

A few megabytes of zeros unpack to as many gigabytes as they claim, and NumPy makes the memory for
an array before it reads it. Here nothing is unpacked before what it claims was compared with what
the archive holds and with a limit.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np

from aquaflow.base.errors import DamagedError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.array_file import Array

UNREADABLE = (
    *(OSError, zipfile.BadZipFile, zlib.error, ValueError, KeyError, TypeError, EOFError),
    *(NotImplementedError, RuntimeError, SyntaxError, MemoryError, RecursionError, struct.error),
)
"""What the functions here raise where an archive is missing, damaged, or a bomb."""
MOST_DIRECTORY_BYTES = 1 << 24
"""Of the list of members, which ``zipfile`` reads into ten times as much memory; a name takes some
70 bytes, and no dive has more than 100,000 keyframes."""
MOST_ARRAY_BYTES = 1 << 27
"""Of a table alone in a file: a site's keyframes take 130 bytes each."""
_END = struct.Struct("<4s4H2LH")
_END_SIGNATURE, _END_64_LOCATOR = b"PK\x05\x06", b"PK\x06\x07"
_END_64, _LOCATOR_BYTES = struct.Struct("<4sQ2H2L4Q"), 20


@contextlib.contextmanager
def open_archive(
    path: Path, stored: bool = False, folders: int = 0, most_bytes: int | None = None
) -> Iterator[zipfile.ZipFile]:
    """A zip file whose members take no more than they may.

    Args:
        stored: the members are not compressed; so they are no longer than the file.
        folders: how many of the folders that hold it belong to the one from others.
        most_bytes: of all members, unpacked.

    Raises:
        UNREADABLE: one of them; DamagedError (a ValueError) says why in words.
    """
    with open_regular(path, folders) as stream:
        _refuse_long_directory(stream)
        with zipfile.ZipFile(stream) as archive:
            entries = archive.infolist()
            claimed = sum(entry.file_size for entry in entries)
            if stored and any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise DamagedError("it is compressed, which AquaFlow's files are not")
            if stored and claimed > os.fstat(stream.fileno()).st_size:
                raise DamagedError("it claims more bytes than it has")
            if most_bytes is not None and claimed > most_bytes:
                raise DamagedError(f"it unpacks to more than {most_bytes >> 20} MB")
            yield archive


def read_member(archive: zipfile.ZipFile, name: str, most_bytes: int) -> bytes:
    """The bytes of one member.

    Raises:
        UNREADABLE: one of them.
    """
    _refuse_long(archive, name, most_bytes)
    return archive.read(name)


def read_array(
    archive: zipfile.ZipFile, name: str, most_bytes: int | None = None
) -> Array:  # of any shape
    """The array in the member ``name``.npy, with its checksum compared.

    Raises:
        UNREADABLE: one of them.
    """
    member = f"{name}.npy"
    entry = _refuse_long(archive, member, most_bytes)
    with archive.open(entry) as stream:
        if _claimed_bytes(stream) + stream.tell() != entry.file_size:
            raise DamagedError("an array claims more or fewer bytes than it has")
    with archive.open(entry) as stream:
        array: Array = np.lib.format.read_array(stream, allow_pickle=False)
        stream.read(1)  # to the end: only then the checksum is compared
        return array


def read_array_file(path: Path, most_bytes: int = MOST_ARRAY_BYTES) -> Array:  # of any shape
    """The array of a ``.npy``.

    Raises:
        UNREADABLE: one of them.
    """
    with open_regular(path, most_bytes=most_bytes) as stream:
        size = os.fstat(stream.fileno()).st_size
        if _claimed_bytes(stream) + stream.tell() != size:
            raise DamagedError("it claims more or fewer bytes than it has")
        stream.seek(0)
        array: Array = np.lib.format.read_array(stream, allow_pickle=False)
        return array


def read_arrays_of(
    path: Path, stored: bool = False, folders: int = 0, most_bytes: int | None = None
) -> dict[str, Array]:  # of any shape
    """All arrays of a ``.npz``, by name.

    Raises:
        UNREADABLE: one of them.
    """
    with open_archive(path, stored, folders, most_bytes) as archive:
        names = archive.namelist()
        if len(set(names)) != len(names):
            raise DamagedError("two arrays have one name")
        if not all(name.endswith(".npy") for name in names):
            raise DamagedError("it holds something else than arrays")
        return {name: read_array(archive, name) for name in (n[:-4] for n in names)}


def _refuse_long(archive: zipfile.ZipFile, name: str, most_bytes: int | None) -> zipfile.ZipInfo:
    entry = archive.getinfo(name)
    if most_bytes is not None and entry.file_size > most_bytes:
        raise DamagedError(f"its {name} has more than {most_bytes} bytes")
    return entry


def _claimed_bytes(stream: IO[bytes]) -> int:
    """Size of the array whose ``.npy`` header begins here."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    return math.prod(shape) * dtype.itemsize


def _refuse_long_directory(stream: BinaryIO) -> None:
    """Compare the length of the list of members (APPNOTE 6.3.10, 4.3.14 and 4.3.16), before
    ``zipfile`` reads it."""
    size = stream.seek(0, io.SEEK_END)
    start = max(0, size - (1 << 16) - _END.size - _LOCATOR_BYTES - _END_64.size)
    stream.seek(start)
    tail = stream.read()
    stream.seek(0)
    end = tail.rfind(_END_SIGNATURE)
    if end < 0 or len(tail) - end < _END.size:
        raise zipfile.BadZipFile("it has no end of its list")
    length = _END.unpack_from(tail, end)[5]
    at_64 = end - _LOCATOR_BYTES - _END_64.size
    if at_64 >= 0 and tail[end - _LOCATOR_BYTES :].startswith(_END_64_LOCATOR):
        length = _END_64.unpack_from(tail, at_64)[8]
    if length > MOST_DIRECTORY_BYTES:
        raise DamagedError("it lists more members than a dive has")
