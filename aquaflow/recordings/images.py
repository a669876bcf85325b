"""A folder of pictures as a camera."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, printable
from aquaflow.geometry.camera import guess_camera, load_camera
from aquaflow.recordings.picture import (
    EXTENSIONS,
    UnreadablePictureError,
    decode_picture,
    grey_16_white,
    probe_size,
    read_picture,
    received_as,
    to_rgb,
)
from aquaflow.types import CameraModel, Dropped, Frame

DEFAULT_FPS = 10.0
"""Pictures without times; stills from survey vehicles come at 1 to 10 a second."""

TIMESTAMPS = "timestamps.txt"
"""One time in seconds for each picture."""
CALIBRATION = "camera.yaml"
"""The camera, if it is known."""
SUBFOLDER = "images"
"""The pictures may be in this folder of the one that is named; so may both files."""

NS_PER_S = 1_000_000_000
"""Nanoseconds of a second."""


class ImageFolder:
    """Pictures in natural order (2.png before 10.png), as a recorded camera.

    The size that most pictures have wins; pictures of another size and unreadable ones are
    yielded as :class:`Dropped`, so that times and indices stay those of the folder.
    """

    specificity = 1

    def __init__(self, folder: Path, fps: float | None = None) -> None:
        """Read sizes, times and calibration.

        Raises:
            InputError: no picture can be read, or the times are malformed.
            ConfigError: the folder's ``camera.yaml`` is malformed.
        """
        self.folder = folder
        self.files = _pictures_of(folder)
        self.frame_count: int | None = len(self.files)
        self._reasons: dict[int, str] = {}
        self.width, self.height = self._majority_size()
        self._times_ns = _times_ns(_sidecar(folder, TIMESTAMPS), self.files, fps)
        calibration = _sidecar(folder, CALIBRATION)
        self.camera: CameraModel | None = load_camera(calibration) if calibration else None
        self._white: int | None = None
        self.notes: list[str] = []
        self._update_notes()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> ImageFolder:
        return cls(path, fps)

    def name_of(self, index: int) -> str:
        """File name of the picture at ``index``."""
        return printable(self.files[index].name)

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The pictures at ``start, start + every, ...`` below ``stop``."""
        end = len(self.files) if stop is None else min(stop, len(self.files))
        for index in range(start, end, every):
            yield self._frame(index)

    def close(self) -> None:
        """Nothing stays open between frames."""

    def _frame(self, index: int) -> Frame | Dropped:
        t_ns = self._times_ns[index]
        if index not in self._reasons:
            try:
                data = self.files[index].read_bytes()
                picture = decode_picture(data)
            except (UnreadablePictureError, OSError) as error:
                self._reasons[index] = f"{self.name_of(index)} {error}"
                self._update_notes()
        if index in self._reasons:
            return Dropped(index, t_ns, self._reasons[index])
        if picture.ndim == 2 and self._white is None:
            self._white = self._folder_white()
        image = to_rgb(picture, self._white or 0)
        camera = self.camera or guess_camera(image.shape[1], image.shape[0])
        # 16-bit grey means nothing without the white of its folder.
        encoded = received_as(data) if picture.ndim == 3 else None
        return Frame(index, t_ns, t_ns, image, camera, encoded=encoded)

    def _folder_white(self) -> int:
        """White of the first 16-bit grey picture: one value for all, or brightness would jump."""
        for index in range(len(self.files)):
            if index in self._reasons:
                continue
            try:
                picture = read_picture(self.files[index])
            except UnreadablePictureError:
                continue
            if picture.ndim == 2:
                return grey_16_white(picture)
        raise AssertionError("called for a folder that has a 16-bit grey picture")

    def _majority_size(self) -> tuple[int, int]:
        """The most frequent size, the earlier on a tie; others are marked as dropped."""
        sizes: dict[int, tuple[int, int]] = {}
        for index, file in enumerate(self.files):
            try:
                sizes[index] = probe_size(file)
            except UnreadablePictureError as error:
                self._reasons[index] = f"{self.name_of(index)} {error}"
        if not sizes:
            raise InputError(
                f"none of the {len(self.files)} pictures in {self.folder} can be read; the first "
                f"is {self.name_of(0)}"
            )
        (width, height), _ = Counter(sizes.values()).most_common(1)[0]
        for index, (w, h) in sizes.items():
            if (w, h) != (width, height):
                self._reasons[index] = (
                    f"{self.name_of(index)} is {w} x {h} while most pictures are {width} x {height}"
                )
        return width, height

    def _update_notes(self) -> None:
        if self._reasons:
            first = self._reasons[min(self._reasons)]
            self.notes = [
                f"{len(self._reasons)} of {len(self.files)} pictures were left out; the first: "
                f"{first}"
            ]


def _pictures_of(folder: Path) -> list[Path]:
    """Picture files of ``folder``, or of its ``images`` folder, in natural order."""
    for place in (folder, folder / SUBFOLDER):
        found = [
            file
            for file in (place.iterdir() if place.is_dir() else ())
            if file.suffix.lower() in EXTENSIONS
            and not file.name.startswith(".")
            and file.is_file()
        ]
        if found:
            return sorted(found, key=_natural_key)
    raise InputError(
        f"{folder} holds no picture; give a folder with {', '.join(sorted(EXTENSIONS))} files or "
        "a video file"
    )


def _natural_key(file: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Numbers by value, text by letter; the name itself decides between 1.png and 01.png."""
    parts = re.split(r"(\d+)", file.name.lower())
    key = [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]
    return key, file.name


def _sidecar(folder: Path, name: str) -> Path | None:
    """``name`` in the folder or in its ``images`` folder, if it is there."""
    for place in (folder, folder / SUBFOLDER):
        if (place / name).is_file():
            return place / name
    return None


def _times_ns(stamps: Path | None, files: list[Path], fps: float | None) -> list[int]:
    """Nanoseconds since the first picture, one for each picture."""
    if stamps is None:
        rate = DEFAULT_FPS if fps is None else fps
        if not (np.isfinite(rate) and rate > 0.0):
            raise InputError(f"a frame rate of {rate:g} pictures a second is not above zero")
        return [round(index * NS_PER_S / rate) for index in range(len(files))]
    seconds = _read_stamps(stamps)
    if len(seconds) != len(files):
        raise InputError(
            f"{stamps} holds {len(seconds)} times for {len(files)} pictures; write one time in "
            "seconds for each picture"
        )
    return [round((second - seconds[0]) * NS_PER_S) for second in seconds]


def _read_stamps(path: Path) -> list[float]:
    seconds: list[float] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the times {path}; write one number a line") from error
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            second = float(text)
        except ValueError as error:
            raise InputError(f"{path} line {number}: this is not a time in seconds") from error
        if not np.isfinite(second) or (seconds and second <= seconds[-1]):
            raise InputError(
                f"{path} line {number}: the time does not come after the one before it"
            )
        seconds.append(second)
    return seconds
