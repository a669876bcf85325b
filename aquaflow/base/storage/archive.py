"""Archives of arrays and facts, of our own and from a folder that others may have made.

A few megabytes of zeros unpack to as many gigabytes as they claim, and NumPy makes the memory for
an array before it reads it. Here nothing is unpacked before what it claims was compared with what
the archive holds and with a limit.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import atomic_write, replacing

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
    path: Path,
    stored: bool = False,
    folders: int = 0,
    most_bytes: int | None = None,
    wanted: Callable[[str], bool] = lambda _: True,
) -> dict[str, Array]:  # of any shape
    """All arrays of a ``.npz``, by name; only those whose name is ``wanted``.

    Raises:
        UNREADABLE: one of them.
    """
    with open_archive(path, stored, folders, most_bytes) as archive:
        names = archive.namelist()
        if len(set(names)) != len(names):
            raise DamagedError("two arrays have one name")
        if not all(name.endswith(".npy") for name in names):
            raise DamagedError("it holds something else than arrays")
        return {name: read_array(archive, name) for name in (n[:-4] for n in names) if wanted(name)}


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


# --------------------------------------------------------------------------------------------------
# Named arrays in a file of their own, which says whose it is and proves that it is undamaged.
#
# One line, ``CRC JSON``, and the arrays' bytes. The JSON is ``{"of": name, "arrays": {name: [dtype,
# shape]}}``; CRC is the CRC-32 of the JSON and all bytes after the line, in eight hexadecimal
# digits. A ``.npz`` of the same picture takes several times as long to read.

Array = npt.NDArray[Any]
Arrays = dict[str, Array]

LONGEST_LINE = 1 << 16
"""Bytes; a line is some hundreds. A damaged file may have no end of line."""


def write_arrays(
    path: Path,
    arrays: Mapping[str, npt.NDArray[Any]],  # by name, of any shape
    of: str = "",
) -> None:
    """Write a file that is whole or not there, unless power fails: then it may be cut short.

    ``of``: what the arrays belong to, so that files which were swapped are noticed.

    Raises:
        OSError: the file cannot be written.
    """
    described = {name: [array.dtype.str, array.shape] for name, array in arrays.items()}
    text = json.dumps({"of": of, "arrays": described}).encode("ascii")
    with replacing(path) as stream:
        stream.write(b"%08x %s\n" % (_checksum(text, arrays), text))
        for array in arrays.values():
            array.tofile(stream)


UNREADABLE_ARRAY = (
    OSError, ValueError, TypeError, AttributeError, LookupError, SyntaxError, RecursionError,
)  # fmt: skip
"""What damage to a file may raise; NumPy reads the name of a type as Python's text."""


def read_arrays(path: Path, of: str = "") -> Arrays:
    """The arrays of ``write_arrays``, in memory of their own.

    Raises:
        InputError: the file is gone, damaged, not an AquaFlow file, or written for another item
        than ``of``.
    """
    try:
        with open_regular(path, folders=1) as stream:
            return _read(stream, of, os.fstat(stream.fileno()).st_size)
    except UNREADABLE_ARRAY as error:
        reason = error.strerror if isinstance(error, OSError) else "it is damaged"
        raise InputError(
            f"cannot read back {path}: {reason}; leave the dive's work folder alone until the end"
        ) from error


def _read(stream: IO[bytes], of: str, size: int) -> Arrays:
    checksum, _, text = stream.readline(LONGEST_LINE).removesuffix(b"\n").partition(b" ")
    header = json.loads(text)
    described = [(n, np.dtype(dtype), shape) for n, (dtype, shape) in header["arrays"].items()]
    claimed = sum(dtype.itemsize * math.prod(shape) for _, dtype, shape in described)
    if header["of"] != of or claimed != size - stream.tell():
        raise ValueError("it is another's, or of another size")
    arrays: Arrays = {}
    for name, dtype, shape in described:
        arrays[name] = np.fromfile(stream, dtype, math.prod(shape)).reshape(shape)
    if checksum != b"%08x" % _checksum(text, arrays):
        raise ValueError("its checksum differs")
    return arrays


def _checksum(
    text: bytes,
    arrays: Mapping[str, npt.NDArray[Any]],  # by name, of any shape
) -> int:
    """0.17 ms for each megabyte."""
    checksum = zlib.crc32(text)
    for array in arrays.values():
        flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        checksum = zlib.crc32(flat.data, checksum)
    return checksum


# --------------------------------------------------------------------------------------------------
# Arrays and facts in one file: a zip of arrays (``.npz``, uncompressed, without pickle) that has a
# JSON text among them.

FACTS = "facts"
"""Name of the array that holds the facts as JSON."""
MOST_FACTS_BYTES = 1 << 26
"""A camera takes 200 bytes, and no dive has a camera for each of 300,000 views."""


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


def read_facts_file(
    path: Path, folders: int = 0, only: str = "", most_bytes: int | None = None
) -> tuple[dict[str, Any], Arrays]:
    """What was written; ``folders`` and ``most_bytes`` as for :func:`open_archive`; ``only``: what
    the names of the arrays that are read begin with.

    Raises:
        UNREADABLE: one of them, of :mod:`aquaflow.base.storage.archive`.
    """
    arrays = read_arrays_of(
        path, True, folders, most_bytes, lambda name: name == FACTS or name.startswith(only)
    )
    text = arrays.pop(FACTS).tobytes()
    if len(text) > MOST_FACTS_BYTES:
        raise DamagedError("its facts are longer than a dive's can be")
    facts: dict[str, Any] = json.loads(text)
    return facts, arrays
