"""One picture file as uint8 RGB, whatever its depth, channels or format; silent on stderr.

Pillow decodes, also TIFF: OpenCV prints a warning to stderr for every private tag of a GeoTIFF.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.recordings.exif import UPRIGHT, orientation_of
from aquaflow.types import EncodedPicture

EXTENSIONS = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm"})
"""Of pictures that Pillow reads."""

LYING = frozenset({5, 6, 7, 8})
"""Orientations of EXIF whose width is the height of the upright picture."""

TWELVE_BITS = 1 << 12
"""Industrial cameras store 12 bits in 16; taking the high byte of those leaves 16 grey levels."""

GREY_16_MODES = frozenset({"I;16", "I;16B", "I;16L", "I;16N", "I"})
"""Pillow's modes of 16-bit grey; as I it has widened them to 32 bits."""


Stored: TypeAlias = npt.NDArray[np.uint8 | np.int32]
"""[H, W, 3] uint8 RGB; what has 16 bits as int32 as stored, [H, W] or [H, W, 3]."""


class UnreadablePictureError(Exception):
    """A picture that cannot be decoded; the message is a reason that follows its name."""


def probe(path: Path) -> tuple[int, int, bool]:
    """Width and height (px) of the upright picture, from the file's header, without decoding; and
    whether it is stored in another position.

    Raises:
        UnreadablePictureError: the header is not that of a picture.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path) as picture:
                (width, height), number = picture.size, orientation_of(picture)
                size = (height, width) if number in LYING else (width, height)
                return *size, number != UPRIGHT
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise UnreadablePictureError("cannot be read as a picture") from error


def read_picture(path: Path) -> Stored:
    """Decode a file; see :func:`decode_picture`.

    Raises:
        UnreadablePictureError: the file is damaged or its pixel type is unknown.
    """
    try:
        return decode_picture(path.read_bytes())
    except OSError as error:
        raise UnreadablePictureError("cannot be read") from error


def decode_picture(data: bytes) -> Stored:
    """Decode to [H, W, 3] uint8 RGB; what has 16 bits to int32 as stored, [H, W] or [H, W, 3].

    Grey of 8 bits becomes RGB, transparency is dropped, and what EXIF says to lie is turned.

    Raises:
        UnreadablePictureError: the data are damaged or their pixel type is unknown.
    """
    from PIL import Image, ImageOps

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data)) as picture:
                if picture.mode in GREY_16_MODES:
                    return np.asarray(picture).astype(np.int32)
                if _has_16_bits(picture, data):
                    return _colour_16(data)
                if picture.mode != "F":
                    lies = orientation_of(picture) != UPRIGHT
                    upright = ImageOps.exif_transpose(picture) if lies else picture
                    return np.array(upright.convert("RGB"), dtype=np.uint8)
                mode = picture.mode
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise UnreadablePictureError("is damaged or cut off") from error
    raise UnreadablePictureError(f"has pixels of type {mode}; convert it to 8 bits per channel")


PNG_DEPTH, TIFF_DEPTH, TIFF_MOST, DNG_WHITE = 24, 258, 281, 50717
"""Where files say their bits a channel, and the value of white: an offset, and tags."""


def _has_16_bits(picture: Any, data: bytes) -> bool:
    """True for colour that Pillow would cut to its high byte."""
    if picture.format == "PNG":
        return data[PNG_DEPTH] == 16
    return picture.format == "TIFF" and 16 in picture.tag_v2.get(TIFF_DEPTH, ())


def _colour_16(data: bytes) -> npt.NDArray[np.int32]:
    """Through OpenCV, as Pillow has no colour of 16 bits."""
    import cv2

    loud = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        flags = cv2.IMREAD_UNCHANGED
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    finally:
        cv2.utils.logging.setLogLevel(loud)
    if bgr is None or bgr.dtype != np.uint16:
        raise UnreadablePictureError("is damaged or cut off")
    return bgr.astype(np.int32) if bgr.ndim == 2 else bgr[..., 2::-1].astype(np.int32)


def stated_white(data: bytes) -> int | None:
    """The value of white that a file of 16 bits states: PNG's sBIT, TIFF's and DNG's tags."""
    from PIL import Image

    if data.startswith(b"\x89PNG"):
        at = data[:4096].find(b"sBIT")
        return None if at < 0 or not 8 < data[at + 4] <= 16 else 1 << data[at + 4]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data)) as picture:
                tags = getattr(picture, "tag_v2", {})
                for tag in (DNG_WHITE, TIFF_MOST):
                    value = tags.get(tag)
                    most = max(value) if isinstance(value, tuple) else value
                    if most is not None and 255 < most < 1 << 16:
                        return int(most) + 1
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return None
    return None


def received_as(data: bytes) -> EncodedPicture | None:
    """``data`` for the recorder, if they are a file of a format that it keeps as it is."""
    if data.startswith(b"\xff\xd8"):
        return EncodedPicture("jpeg", data)
    if data.startswith(b"\x89PNG"):
        return EncodedPicture("png", data)
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return EncodedPicture("webp", data)
    return None


class WhiteLevel:
    """White of a recording's pictures of 16 bits: one value for all, or brightness would jump."""

    def __init__(self) -> None:
        self._white: int | None = None
        self.sources: dict[str, str] = {}
        """What is taken as ``white`` and why, once a picture of 16 bits was met."""

    def to_rgb(
        self,
        picture: Stored,  # [H, W] or [H, W, 3]
        stated: Callable[[], int | None],
        whole: Callable[[], Iterator[Stored]],
    ) -> npt.NDArray[np.uint8]:
        """[H, W, 3]; the first picture of 16 bits decides: by the white that it has ``stated``,
        else by the brightest of the ``whole`` recording."""
        if picture.dtype == np.uint8:
            return to_rgb(picture, 1)
        if self._white is None:
            self._white, self.sources["white"] = _white_of(stated(), whole)
        return to_rgb(picture, self._white)


def _white_of(stated: int | None, whole: Callable[[], Iterator[Stored]]) -> tuple[int, str]:
    if stated is not None:
        said = f"white is {stated - 1} in pictures of 16 bits, as their header says"
        return stated, said
    assumed = "white is assumed to be {} in pictures of 16 bits: {}"
    for picture in whole():
        if picture.dtype != np.uint8 and int(picture.max()) >= TWELVE_BITS:
            white = 1 << 16
            return white, assumed.format(white - 1, f"values above {TWELVE_BITS} occur")
    return TWELVE_BITS, assumed.format(TWELVE_BITS - 1, "none is brighter")


def to_rgb(
    picture: Stored,  # [H, W] or [H, W, 3]
    white: int,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] uint8 RGB; 16 bits are scaled so that ``white`` becomes 256."""
    if picture.dtype != np.uint8:
        picture = np.clip(picture.astype(np.int32) * 256 // white, 0, 255).astype(np.uint8)
    rgb = picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)
    return np.ascontiguousarray(rgb, dtype=np.uint8)
