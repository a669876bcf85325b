"""One picture file as uint8 RGB, whatever its depth, channels or format; silent on stderr.

Pillow decodes, also TIFF: OpenCV prints a warning to stderr for every private tag of a GeoTIFF.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.types import EncodedPicture

EXTENSIONS = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm"})
"""Of pictures that Pillow reads."""

TWELVE_BITS = 1 << 12
"""Industrial cameras store 12 bits in 16; taking the high byte of those leaves 16 grey levels."""

GREY_16_MODES = frozenset({"I;16", "I;16B", "I;16L", "I;16N", "I"})
"""Pillow's modes of 16-bit grey; as I it has widened them to 32 bits."""


class UnreadablePictureError(Exception):
    """A picture that cannot be decoded; the message is a reason that follows its name."""


def probe_size(path: Path) -> tuple[int, int]:
    """Width and height (px) from the file's header, without decoding.

    Raises:
        UnreadablePictureError: the header is not that of a picture.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path) as picture:
                return picture.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise UnreadablePictureError("cannot be read as a picture") from error


def read_picture(path: Path) -> npt.NDArray[np.uint8 | np.int32]:
    """Decode a file; see :func:`decode_picture`.

    Raises:
        UnreadablePictureError: the file is damaged or its pixel type is unknown.
    """
    try:
        return decode_picture(path.read_bytes())
    except OSError as error:
        raise UnreadablePictureError("cannot be read") from error


def decode_picture(data: bytes) -> npt.NDArray[np.uint8 | np.int32]:
    """Decode to [H, W, 3] uint8 RGB, or, for 16-bit grey, to [H, W] int32 as stored.

    Grey becomes RGB, transparency is dropped, 16-bit colour keeps its high byte.

    Raises:
        UnreadablePictureError: the data are damaged or their pixel type is unknown.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data)) as picture:
                if picture.mode in GREY_16_MODES:
                    return np.asarray(picture).astype(np.int32)
                if picture.mode != "F":
                    return np.array(picture.convert("RGB"), dtype=np.uint8)
                mode = picture.mode
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise UnreadablePictureError("is damaged or cut off") from error
    raise UnreadablePictureError(f"has pixels of type {mode}; convert it to 8 bits per channel")


def received_as(data: bytes) -> EncodedPicture | None:
    """``data`` for the recorder, if they are a file of a format that it keeps as it is."""
    if data.startswith(b"\xff\xd8"):
        return EncodedPicture("jpeg", data)
    if data.startswith(b"\x89PNG"):
        return EncodedPicture("png", data)
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return EncodedPicture("webp", data)
    return None


def grey_16_white(
    grey: npt.NDArray[np.uint8 | np.int32],  # [H, W] as from read_picture
) -> int:
    """The value that is white in 16-bit pictures like this one: 2^12 or 2^16."""
    return TWELVE_BITS if int(grey.max()) < TWELVE_BITS else 1 << 16


def to_rgb(
    picture: npt.NDArray[np.uint8 | np.int32],  # [H, W, 3] or [H, W] as from read_picture
    white: int,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] uint8 RGB; 16-bit grey is scaled so that ``white`` becomes 256."""
    if picture.ndim == 3:
        return picture.astype(np.uint8, copy=False)
    grey = np.clip(picture * 256 // white, 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
