"""Recordings as people have them, each made of one small dive: the table that is read and mapped.

A row makes its recording from the dive's pictures; what the reader gives is compared with the
pictures themselves, and poses with those of the same pictures read plainly: PNG files with
``timestamps.txt`` and ``camera.yaml``.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel, load_camera, save_camera
from aquaflow.recordings.picture import decode_picture

COUNT, RATE_HZ = 14, 10.0
"""Pictures of a row and how many there are a second: enough for a start and a few poses."""
NEAR = 3.0
"""Grey levels, mean over the picture, that a good lossy codec costs."""

Picture = npt.NDArray[np.uint8]
"""[H, W, 3] RGB."""


@dataclass(frozen=True)
class Dive:
    """The pictures that every row is made of."""

    pictures: Sequence[Picture]
    camera: CameraModel
    truth: Path
    """Its poses, poses.tum."""
    fields: Sequence[Picture] = ()
    """All pictures of the dive, of which two make one that is interlaced."""

    @property
    def times_s(self) -> list[float]:
        return [index / RATE_HZ for index in range(len(self.pictures))]


@dataclass
class Made:
    """A recording, and what must be read of it."""

    source: Path
    pictures: Sequence[Picture | None]
    """None: one that is left out."""
    times_s: list[float]
    camera: CameraModel | None = None
    """Of the recording; None where it brings none: then the true one is given."""
    fps: float | None = None
    topic: str | None = None
    calibration: Path | None = None
    """Given beside the recording, of ``camera``."""
    log: Path | None = None
    """With telemetry: the recording itself, or beside it and beginning with it."""
    samples: Sequence[tuple[float, float]] = ()
    """Seconds and metres of the depths in ``log``."""
    utc: Sequence[tuple[float, float]] = ()
    """Seconds and seconds since 1970, of the UTC in a log that must say it."""
    fixes: Sequence[tuple[float, float, float, float]] = ()
    """Seconds, latitude, longitude and metres of the fixes in ``log``."""
    log_says: str = ""
    """In the notes of the log."""
    every: int = 1
    """Pictures of the dive from one of the recording to the next."""
    plain: Sequence[Picture | None] | None = None
    """The pictures of the plain reading where coding changed them; None: ``pictures``."""


Make = Callable[[Dive, Path], Made]


@dataclass(frozen=True)
class Row:
    """One kind of recording."""

    name: str
    make: Make
    near: float = NEAR
    """Grey levels between what is read and the picture, mean over a picture."""
    says: str = ""
    """In the recording's notes."""
    refuses: str = ""
    """Words of the refusal of a recording that cannot be used."""
    needs: str = ""
    """A program."""
    most_ratio: float = 1.2
    """Error over that of the plain reading."""


ROWS: list[Row] = []
Made_ = TypeVar("Made_", bound=Make)


def row(
    name: str,
    *,
    near: float = NEAR,
    says: str = "",
    refuses: str = "",
    needs: str = "",
    most_ratio: float = 1.2,
) -> Callable[[Made_], Made_]:
    """Add the function as a row; see :class:`Row`."""

    def add(make: Made_) -> Made_:
        ROWS.append(Row(name, make, near, says, refuses, needs, most_ratio))
        return make

    return add


def dive_of(recording: Path) -> Dive:
    """The first pictures of a synthetic dive."""
    files = sorted((recording / "images").iterdir())
    pictures = [np.asarray(decode_picture(file.read_bytes()), np.uint8) for file in files]
    camera, truth = load_camera(recording / "camera.yaml"), recording / "poses.tum"
    return Dive(pictures[:COUNT], camera, truth, pictures)


def made(dive: Dive, source: Path, **changes: object) -> Made:
    """All pictures of the dive at its own times."""
    values: dict[str, object] = {"pictures": dive.pictures, "times_s": dive.times_s}
    return Made(source, **(values | changes))  # type: ignore[arg-type]


def write_png(path: Path, picture: npt.NDArray[np.generic]) -> None:
    """RGB or grey, 8 or 16 bits."""
    import cv2

    bgr = picture[..., ::-1] if picture.ndim == 3 else picture
    assert cv2.imwrite(str(path), np.ascontiguousarray(bgr))


def write_plainly(folder: Path, read: Made, camera: CameraModel) -> Path:
    """The pictures of ``read`` as the plainest recording there is."""
    (folder / "images").mkdir(parents=True)
    times = []
    for index, picture in enumerate(read.pictures):
        if picture is not None:
            write_png(folder / "images" / f"{index:04d}.png", picture)
            times.append(f"{read.times_s[index]:.9f}")
    (folder / "timestamps.txt").write_text("\n".join(times))
    save_camera(camera, folder / "camera.yaml")
    return folder


def run_ffmpeg(*arguments: object, data: bytes | None = None) -> bytes:
    """Run the program, silent unless it fails; what it writes."""
    program = shutil.which("ffmpeg")
    if program is None:
        pytest.skip("the program ffmpeg is not installed")
    command = [program, "-v", "error", "-y", *map(str, arguments)]
    return subprocess.run(
        command, input=data, stdout=subprocess.PIPE, check=True, timeout=120
    ).stdout
