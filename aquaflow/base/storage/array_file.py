"""Named arrays in a file of their own, which says whose it is and proves that it is undamaged.

One line, ``CRC JSON``, and the arrays' bytes. The JSON is ``{"of": name, "arrays": {name: [dtype,
shape]}}``; CRC is the CRC-32 of the JSON and all bytes after the line, in eight hexadecimal digits.
A ``.npz`` of the same picture takes several times as long to read.
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import replacing

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


UNREADABLE = (
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
    except UNREADABLE as error:
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
