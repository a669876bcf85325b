"""Pictures as PNG files that are whole or not there."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.atomic import atomic_write

MOST_PIXELS = 1 << 24
"""Of a picture in a dive folder: 16 million, more than any is mapped in."""
HEADER = 8 + 25
"""Bytes of a PNG's signature and of its first chunk."""


def encoded_png(
    picture: npt.NDArray[np.uint8],  # [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA
) -> bytes:
    """The content of a PNG file."""
    import cv2

    if picture.ndim == 3:
        to_bgr = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        picture = np.asarray(cv2.cvtColor(picture, to_bgr), dtype=np.uint8)
    _, encoded = cv2.imencode(".png", picture)
    return encoded.tobytes()


def read_png(
    path: Path, folders: int = 0
) -> npt.NDArray[np.uint8]:  # [H, W], [H, W, 3] RGB or [H, W, 4] RGBA
    """The picture in a file of a folder that others may have made.

    ``folders`` as for :func:`aquaflow.base.errors.regular_file.open_regular`.

    Raises:
        OSError, ValueError: it cannot be read, is no PNG, or has more pixels than AquaFlow maps.
    """
    from PIL import Image

    stream = io.BytesIO(read_regular(path, folders))
    try:
        with Image.open(stream, formats=("PNG",)) as picture:
            if math.prod(picture.size) > MOST_PIXELS:
                raise DamagedError("it has more pixels than a mapped picture")
            return np.asarray(picture)
    except (SyntaxError, Image.DecompressionBombError) as error:
        raise DamagedError("it is no picture") from error


def write_png(
    path: Path,
    picture: npt.NDArray[np.uint8],  # [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA
    exif: bytes | None = None,
) -> None:
    """Write ``picture``, with ``exif`` if there is some.

    Raises:
        InputError: the file cannot be written.
    """
    content = encoded_png(picture)
    if exif is not None:
        content = content[:HEADER] + _chunk(b"eXIf", exif) + content[HEADER:]
    with atomic_write(path) as stream:
        stream.write(content)


def _chunk(name: bytes, content: bytes) -> bytes:
    """Of a PNG file (ISO/IEC 15948)."""
    named = name + content
    return struct.pack(">I", len(content)) + named + struct.pack(">I", zlib.crc32(named))
