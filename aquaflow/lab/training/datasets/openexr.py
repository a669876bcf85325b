"""Depth from OpenEXR files, as simulators write them: one part, scan lines, float or half numbers.

OpenCV's wheels are built without OpenEXR; of its format (openexr.com, "File Layout") this reads
what AirSim writes: no compression, or zip of one or of sixteen lines.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of

MAGIC = 20000630
"""The first four bytes of an OpenEXR file."""
LINES = {0: 1, 2: 1, 3: 16}
"""Lines of a block by compression: none, zip of one line, zip."""
DTYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f2"), 2: np.dtype("<f4")}
"""Pixel types half and float."""


@dataclass(frozen=True)
class _Header:
    channels: list[tuple[str, np.dtype[Any]]]
    """In the order of the file."""
    compression: int
    height: int
    width: int
    first_line: int


def read_exr(path: Path) -> npt.NDArray[np.float32]:
    """[H, W] the first channel.

    Raises:
        InputError: the file is damaged, or of a kind that is not read here.
    """
    try:
        data = path.read_bytes()
        if struct.unpack_from("<I", data)[0] != MAGIC:
            raise DamagedError("it is no OpenEXR file")
        header, at = _header(data)
        return _pixels(data, header, at)
    except (OSError, ValueError, LookupError, struct.error, zlib.error) as error:
        said = reason_of(error)
        raise InputError(f"cannot read {path} ({said}); convert it to 32-bit zip") from error


def _header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the blocks' offsets begin."""
    at, found = 8, {}
    while data[at] != 0:
        name, at = _string(data, at)
        _, at = _string(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        found[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    x0, y0, x1, y1 = struct.unpack("<4i", found["dataWindow"])
    header = _Header(
        _channels(found["channels"]), found["compression"][0], y1 - y0 + 1, x1 - x0 + 1, y0
    )
    if header.compression not in LINES:
        raise DamagedError(f"its compression is number {header.compression}")
    return header, at + 1


def _channels(data: bytes) -> list[tuple[str, np.dtype[Any]]]:
    at, channels = 0, []
    while data[at] != 0:
        name, at = _string(data, at)
        channels.append((name, DTYPES[struct.unpack_from("<i", data, at)[0]]))
        at += 16
    return channels


def _string(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("latin-1"), end + 1


def _pixels(data: bytes, header: _Header, at: int) -> npt.NDArray[np.float32]:
    lines = LINES[header.compression]
    blocks = -(-header.height // lines)
    image = np.zeros((header.height, header.width), np.float32)
    line_bytes = sum(dtype.itemsize for _, dtype in header.channels) * header.width
    first = header.channels[0][1]
    for offset in struct.unpack_from(f"<{blocks}Q", data, at):
        line, size = struct.unpack_from("<ii", data, offset)
        row = line - header.first_line
        count = min(lines, header.height - row)
        block = data[offset + 8 : offset + 8 + size]
        if header.compression and size < count * line_bytes:
            block = _inflate(block)
        rows = np.frombuffer(block, np.uint8).reshape(count, line_bytes)
        values = np.ascontiguousarray(rows[:, : first.itemsize * header.width]).view(first)
        image[row : row + count] = values
    return image


def _inflate(block: bytes) -> bytes:
    """Unzip, undo the differences, and put the two interleaved halves together."""
    raw = np.frombuffer(zlib.decompress(block), np.uint8).astype(np.int64)
    raw[1:] -= 128
    whole = np.cumsum(raw).astype(np.uint8)
    half = (len(whole) + 1) // 2
    merged = np.empty_like(whole)
    merged[0::2], merged[1::2] = whole[:half], whole[half:]
    return merged.tobytes()
