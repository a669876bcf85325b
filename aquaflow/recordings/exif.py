"""What cameras write beside the pixels of stills: when, where, and which way up they were taken.

EXIF 2.32 (CIPA DC-008-2019): times have no zone; positions are those of the camera's receiver.
"""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

EXTENSIONS = frozenset({".jpg", ".jpeg", ".tif", ".tiff", ".webp"})
"""Of files that have EXIF and that cameras write; Pillow decodes a PNG to look for it."""
ORIENTATION, CAMERA, RECEIVER = 0x0112, 0x8769, 0x8825
"""How the picture is turned, and the directories of the camera and of its receiver."""
TAKEN, SUBSECONDS = 0x9003, 0x9291
"""Of the camera's: when the picture was taken, and decimals of that."""
LATITUDE, LONGITUDE, ERROR_M = 2, 4, 31
"""Of the receiver's: degrees, minutes, seconds, each after its hemisphere, and 1 sigma."""
TURNED_BY_READER = frozenset({"JPEG", "MPO", "WEBP"})
"""Formats whose pictures Pillow leaves as they are stored; those of TIFF it turns itself."""
UPRIGHT = 1
"""Orientation of a picture that is stored as it is seen."""


class Place(NamedTuple):
    """Where a picture was taken."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float | None
    """1 sigma, horizontal; None: not stated."""


def orientation_of(picture: Any) -> int:
    """1 to 8 of an open Pillow picture that its reader has to turn; 1 is upright."""
    if picture.format in TURNED_BY_READER:
        with _damage_ignored():
            return int(picture.getexif().get(ORIENTATION, UPRIGHT))
    return UPRIGHT


def time_taken(file: Path) -> tuple[str, int] | None:
    """``EXIF`` and the ns from 1970 in the camera's own zone; None where the file says none."""
    with _damage_ignored():
        exif = _directory(file, CAMERA)
        moment = datetime.strptime(str(exif[TAKEN]), "%Y:%m:%d %H:%M:%S")
        whole = int(moment.replace(tzinfo=timezone.utc).timestamp())
        digits = re.sub(r"\D", "", str(exif.get(SUBSECONDS, "")))[:9]
        return "EXIF", whole * 1_000_000_000 + int(digits.ljust(9, "0"))
    return None


def place_taken(file: Path) -> Place | None:
    """None where the file says none."""
    with _damage_ignored():
        exif = _directory(file, RECEIVER)
        latitude, longitude = (
            (-1.0 if str(exif[tag - 1]).upper() in "SW" else 1.0)
            * sum(float(part) / 60.0**n for n, part in enumerate(exif[tag]))
            for tag in (LATITUDE, LONGITUDE)
        )
        sigma_m = float(exif.get(ERROR_M, 0.0))
        if math.isfinite(latitude) and math.isfinite(longitude):
            return Place(latitude, longitude, sigma_m if sigma_m > 0.0 else None)
    return None


def _directory(file: Path, number: int) -> dict[int, Any]:
    from PIL import Image

    if file.suffix.lower() not in EXTENSIONS:
        return {}
    with Image.open(file) as picture:
        return dict(picture.getexif().get_ifd(number))


@contextmanager
def _damage_ignored() -> Iterator[None]:
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # Pillow has many for bad EXIF
        warnings.simplefilter("ignore")
        yield
