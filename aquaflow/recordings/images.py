"""A folder of pictures as a camera, and the places in their EXIF as telemetry."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, printable
from aquaflow.drivers.samples import plausible, sigma_of
from aquaflow.geometry.camera import guess_camera, load_camera
from aquaflow.recordings.exif import place_taken, time_taken
from aquaflow.recordings.picture import (
    EXTENSIONS,
    Stored,
    UnreadablePictureError,
    WhiteLevel,
    decode_picture,
    probe,
    read_picture,
    received_as,
    stated_white,
)
from aquaflow.types import CameraModel, Dropped, Frame, Position, TelemetrySample

DEFAULT_FPS = 10.0
"""Pictures without times; stills from survey vehicles come at 1 to 10 a second."""

TIMESTAMPS = "timestamps.txt"
"""One time in seconds for each picture."""
CALIBRATION = "camera.yaml"
"""The camera, if it is known."""
SENSOR = "sensor.yaml"
"""The camera in a folder of EuRoC's layout."""
SUBFOLDER = "images"
SUBFOLDERS = (SUBFOLDER, "data")
"""The pictures may be in such a folder of the one that is named, and so may the files beside them;
EuRoC's is ``data``."""

MOST_NAMED = 8
"""Names that are said of what lies in a folder."""
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
        self._turned = 0
        self._facts: dict[str, str] = {}
        self.width, self.height = self._majority_size()
        stamps = _sidecar(folder, TIMESTAMPS)
        self._times_ns, self._facts["times"] = _times_ns(stamps, self.files, fps)
        calibration = _sidecar(folder, CALIBRATION) or _sidecar(folder, SENSOR)
        self.camera: CameraModel | None = load_camera(calibration) if calibration else None
        if calibration is not None:
            self._facts["calibration"] = f"the calibration is {calibration}"
        self._white = WhiteLevel()

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

    def time_of(self, index: int) -> int:
        """ns from the first picture to that at ``index``."""
        return self._times_ns[index]

    def _frame(self, index: int) -> Frame | Dropped:
        t_ns = self.time_of(index)
        if index not in self._reasons:
            try:
                data = self.files[index].read_bytes()
                picture = decode_picture(data)
            except (UnreadablePictureError, OSError) as error:
                self._reasons[index] = f"{self.name_of(index)} {error}"
        if index in self._reasons:
            return Dropped(index, t_ns, self._reasons[index])
        image = self._white.to_rgb(picture, lambda: stated_white(data), self._whole)
        camera = self.camera or guess_camera(image.shape[1], image.shape[0])
        # 16 bits mean nothing without the white of their folder.
        encoded = received_as(data) if picture.dtype == np.uint8 else None
        return Frame(index, t_ns, t_ns, image, camera, encoded=encoded)

    def _whole(self) -> Iterator[Stored]:
        for index, file in enumerate(self.files):
            if index not in self._reasons:
                with contextlib.suppress(UnreadablePictureError):
                    yield read_picture(file)

    def _majority_size(self) -> tuple[int, int]:
        """The most frequent size, the earlier on a tie; others are marked as dropped."""
        sizes: dict[int, tuple[int, int]] = {}
        for index, file in enumerate(self.files):
            try:
                width, height, turned = probe(file)
                sizes[index] = width, height
                self._turned += turned
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

    def sources(self) -> dict[str, str]:
        """Sources of times, calibration, white and position."""
        found = self._facts | self._white.sources
        if self._turned:
            found["position"] = f"{self._turned} pictures are turned as their EXIF says"
        return found

    @property
    def notes(self) -> list[str]:
        """The sources, and what was left out."""
        found = list(self.sources().values())
        if self._reasons:
            first = self._reasons[min(self._reasons)]
            found.append(
                f"{len(self._reasons)} of {len(self.files)} pictures were left out; the first: "
                f"{first}"
            )
        return found


class StillsTelemetry:
    """Places in the EXIF of a folder's pictures, at the pictures' times."""

    specificity = 1

    def __init__(self, folder: Path, starts_s: float = 0.0) -> None:
        """Open nothing yet."""
        self.folder = folder
        self._fps: float | None = None
        self.notes: list[str] = []
        self._shift_ns = round(starts_s * NS_PER_S)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if not path.is_dir():
            return False
        with contextlib.suppress(InputError):
            return place_taken(_pictures_of(path)[0]) is not None
        return False

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> StillsTelemetry:
        return cls(path, starts_s)

    def follow(self, fps: float | None, topic: str | None) -> None:
        """``fps`` is the rate of pictures of which the folder says no times."""
        self._fps = fps

    def samples(self) -> Iterator[TelemetrySample]:
        """A fix for each picture that has one.

        Raises:
            InputError: no picture can be read, or the times are malformed.
        """
        pictures = ImageFolder(self.folder, self._fps)
        for index, file in enumerate(pictures.files):
            place = place_taken(file)
            if place is not None:
                t_ns = pictures.time_of(index) + self._shift_ns
                sigma_m = place.sigma_m or sigma_of(None)
                fix = Position(t_ns, t_ns, "EXIF", *place[:2], sigma_m)
                if plausible(fix):
                    yield fix

    def close(self) -> None:
        """Nothing stays open between passes."""


def _pictures_of(folder: Path) -> list[Path]:
    """Picture files of ``folder``, or of one of its ``SUBFOLDERS``, in natural order."""
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        found = [
            file
            for file in (place.iterdir() if place.is_dir() else ())
            if file.suffix.lower() in EXTENSIONS
            and not file.name.startswith(".")
            and file.is_file()
        ]
        if found:
            times = [time_of_name(file.stem) for file in found]
            if None not in times and len({time[0] for time in times if time}) == 1:
                return sorted(found, key=lambda file: (time_of_name(file.stem), file.name))
            return sorted(found, key=_natural_key)
    others = sorted(printable(file.name) for file in folder.iterdir())[:MOST_NAMED]
    raise InputError(
        f"{folder} holds no picture; give a folder with {', '.join(sorted(EXTENSIONS))} files or "
        f"a video file; in it {'are ' + ', '.join(others) if others else 'is nothing'}"
    )


def _natural_key(file: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Numbers by value, text by letter; the name itself decides between 1.png and 01.png."""
    parts = re.split(r"(\d+)", file.name.lower())
    key = [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]
    return key, file.name


def _sidecar(folder: Path, name: str) -> Path | None:
    """``name`` in the folder or in one of its ``SUBFOLDERS``, if it is there."""
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        if (place / name).is_file():
            return place / name
    return None


DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[T _-]?"
    r"([0-2]\d)[-_:.h]?([0-5]\d)[-_:.m]?([0-6]\d)(?:[.,](\d{1,9})|_?(\d{3}|\d{6}|\d{9}))?(?!\d)"
)
"""A date with a time of day, as ISO 8601, DJI and recorders write it."""
EPOCH = re.compile(r"(?<!\d)(1\d{9})(?:\.(\d{1,9})|_?(\d{3}|\d{6}|\d{9}))?(?!\d)")
"""Seconds since 1970 (2001 to 2033), with decimals, or as milli-, micro- or nanoseconds."""
SECONDS = re.compile(r"(?<![\d.])(\d+)\.(\d{1,9})s?$")
"""Seconds with decimals at the end of a name."""


def time_of_name(stem: str) -> tuple[str, int] | None:
    """What the time in a picture's name is, and its ns; None where the name holds none."""
    if found := DATE.search(stem):
        year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
        fraction = found[7] or found[8] or ""
        with contextlib.suppress(ValueError):
            moment = datetime(year, month, day, hour, minute, second, tzinfo=timezone.utc)
            return "dates", int(moment.timestamp()) * NS_PER_S + _decimals_ns(fraction)
    if found := EPOCH.search(stem):
        return "seconds since 1970", int(found[1]) * NS_PER_S + _decimals_ns(
            found[2] or found[3] or ""
        )
    if found := SECONDS.search(stem):
        return "seconds", int(found[1]) * NS_PER_S + _decimals_ns(found[2])
    return None


def _decimals_ns(digits: str) -> int:
    return int(digits.ljust(9, "0"))


def _times_ns(stamps: Path | None, files: list[Path], fps: float | None) -> tuple[list[int], str]:
    """Nanoseconds since the first picture, one for each picture, and a sentence on their source."""
    if stamps is not None:
        seconds = _read_stamps(stamps)
        if len(seconds) != len(files):
            raise InputError(
                f"{stamps} holds {len(seconds)} times for {len(files)} pictures; write one time in "
                "seconds for each picture"
            )
        times = [round((second - seconds[0]) * NS_PER_S) for second in seconds]
        return times, f"the times of the pictures are those of {stamps}"
    if fps is not None:
        return _evenly(len(files), fps), f"the pictures have the {fps:g} a second that were given"
    if (listed := _listed_times(files)) is not None:
        path, times = listed
        return times, f"the times of the pictures are those of {path}"
    if (named := _increasing(time_of_name(file.stem) for file in files)) is not None:
        kind, times = named
        return times, f"the times of the pictures are the {kind} in their names"
    if (taken := _increasing(time_taken(file) for file in files)) is not None:
        return taken[1], "the times of the pictures are those of their EXIF"
    return _evenly(len(files), DEFAULT_FPS), (
        f"the times of the pictures are not known: {DEFAULT_FPS:g} a second are assumed; give "
        f"{TIMESTAMPS} or --fps"
    )


def _evenly(count: int, rate: float) -> list[int]:
    return [round(index * NS_PER_S / rate) for index in range(count)]


def _increasing(times: Iterable[tuple[str, int] | None]) -> tuple[str, list[int]] | None:
    """Kind and ns since the first, if all are of one kind and none is twice or earlier; none is
    looked for after one that is missing."""
    known = []
    for time in times:
        if time is None:
            return None
        known.append(time)
    if len(known) < 2 or len({kind for kind, _ in known}) > 1:
        return None
    ns = [time for _, time in known]
    if any(after <= before for before, after in pairwise(ns)):
        return None
    return known[0][0], [time - ns[0] for time in ns]


LISTS = (".csv", ".txt")
"""Endings of a table that names each picture and its time, beside the pictures or above them, such
as EuRoC's ``data.csv`` and TUM's ``rgb.txt``."""
LARGEST_LIST = 64 * 1024 * 1024
"""Bytes: a million pictures and more; a larger file is something else."""
LONGEST_HEADER = 100
"""Lines before the first that names a picture; a table without one, such as a log of the vehicle,
is not read on. EuRoC's and TUM's have one and three."""
TIME_WORD = re.compile(r"time|stamp", re.IGNORECASE)
"""In the header's name of the times."""
DECIMAL = re.compile(r"\d{1,19}(\.\d*)?")
UNIT = re.compile(r"[\[(_](ns|us|ms|s)(?![a-z])")
"""The unit of times in a header."""
UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": NS_PER_S}
EPOCH_UNITS = ((10**17, "ns"), (10**14, "us"), (10**11, "ms"))
"""Numbers from which on a time since 1970 has this unit: seconds have ten digits."""
SECONDS_SINCE_1970 = 10**9
"""In September 2001."""


def _listed_times(files: list[Path]) -> tuple[Path, list[int]] | None:
    """The first table that has a time for every picture, each after the one before, and these in ns
    since the first."""
    places = (files[0].parent, files[0].parent.parent)
    tables = [path for place in places for path in sorted(place.glob("*")) if _may_list(path)]
    for path in tables:
        found = _times_of_list(path)
        times = [found[file.name] for file in files if file.name in found]
        if len(times) == len(files) and all(after > before for before, after in pairwise(times)):
            return path, [time - times[0] for time in times]
    return None


def _may_list(path: Path) -> bool:
    return path.suffix.lower() in LISTS and path.is_file() and path.stat().st_size <= LARGEST_LIST


def _times_of_list(path: Path) -> dict[str, int]:
    """Time in ns of each picture that a line of the table names."""
    try:
        with path.open(encoding="utf-8-sig") as lines:
            return _times_of_lines(lines)
    except (OSError, UnicodeDecodeError):
        return {}


def _times_of_lines(lines: Iterable[str]) -> dict[str, int]:
    times: dict[str, int] = {}
    column, unit, named = None, None, False
    for number, line in enumerate(lines):
        words = _words_of(line)
        names = [Path(word).name for word in words if Path(word).suffix.lower() in EXTENSIONS]
        named = named or bool(names)
        if names:
            time_ns = _in_ns(words if column is None else words[column : column + 1], unit)
            if time_ns is not None:
                times[names[0]] = time_ns
        elif not named and number >= LONGEST_HEADER:
            break
        elif column is None and not times:
            column = next((n for n, word in enumerate(words) if TIME_WORD.search(word)), None)
            unit = stated[1] if (stated := UNIT.search(line)) else None
    return times


def _words_of(line: str) -> list[str]:
    line = line.rstrip("\n").lstrip("# ")
    separated = re.split(r"[,;\t]", line) if re.search(r"[,;\t]", line) else line.split()
    return [word.strip("\"' ") for word in separated]


def _in_ns(words: list[str], unit: str | None) -> int | None:
    """The first number, in ns; without a header it must be a time since 1970, because a number of
    the picture or a place is none."""
    for word in words:
        if DECIMAL.fullmatch(word):
            whole, _, decimals = word.partition(".")
            usual = next((name for least, name in EPOCH_UNITS if int(whole) >= least), "s")
            scale = UNITS_NS[unit or usual]
            if len(words) == 1 or int(whole) >= SECONDS_SINCE_1970:
                return int(whole) * scale + _decimals_ns(decimals[:9]) * scale // NS_PER_S
    return None


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
