"""A video file as a camera."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from itertools import count, takewhile
from pathlib import Path

import numpy as np

from aquaflow.base.errors import printable
from aquaflow.geometry.camera import ASPECT_TOLERANCE, guess_camera, load_camera
from aquaflow.recordings.images import CALIBRATION, DEFAULT_FPS, NS_PER_S, SUBFOLDER
from aquaflow.recordings.picture import EXTENSIONS as PICTURES
from aquaflow.recordings.picture import UnreadablePictureError
from aquaflow.recordings.video_decoder import VideoDecoder, read_index
from aquaflow.sources import is_asked
from aquaflow.types import CameraModel, Dropped, Frame

EXTENSIONS = frozenset({
    ".mp4", ".m4v", ".mov", ".3gp", ".insv", ".lrv", ".avi", ".mkv", ".webm", ".ogv", ".wmv",
    ".asf", ".flv", ".mpg", ".mpeg", ".m2v", ".vob", ".mod", ".ts", ".mts", ".m2ts", ".m2t",
    ".mxf", ".dv", ".h264", ".264", ".h265", ".hevc", ".mjpeg", ".mjpg",
})  # fmt: skip
"""Of files in containers that FFmpeg reads and cameras write."""

BARE = frozenset({".h264", ".264", ".h265", ".hevc", ".mjpeg", ".mjpg"})
"""Of streams without a container: they hold no times, and FFmpeg takes 25 a second for them."""
COUNT_TOLERANCE = 1
"""Some containers give a duration instead of a count; one frame less is not a cut-off video."""
CHAPTERS = (
    (re.compile(r"(G[A-Z])01(\d{4})(\.\w+)", re.IGNORECASE), "{0}{chapter:02d}{1}{2}", 2),
    (re.compile(r"(G)OPR(\d{4})(\.\w+)", re.IGNORECASE), "{0}P{chapter:02d}{1}{2}", 1),
)
"""First file of a GoPro recording, the names of its others, and the number of the second one."""

SENSORS = {b"gpmd": "GoPro", b"djmd": "DJI", b"camm": "Google", b"rtmd": "Sony"}
"""Formats of streams in MP4 with what a camera's sensors measured, and whose they are."""
FORMAT = re.compile(rb"stsd.{12}(.{4})", re.DOTALL)
"""A stream's format in the index of an MP4 (ISO 14496-12, 8.5.2)."""


class VideoFile:
    """Frames of a video with the times of its container.

    Frames that are not asked for are only grabbed: decoded as far as the codec needs, never
    converted, which makes ``every`` cheap. Pixels that are not square are made so. The first
    chapter of a GoPro recording brings the others.
    """

    specificity = 2

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Open the video, or the only one of a folder, and decode its first frame.

        Raises:
            InputError: the file is not a video, or no frame of it can be decoded.
            ConfigError: the ``camera.yaml`` next to it is malformed.
        """
        path = video_of(path) or path
        self.path = path
        self.files = _chapters(path)
        self._facts: dict[str, str] = {}
        with VideoDecoder(path) as decoder:
            self.width, self.height = decoder.width, decoder.height
            rate, pixel, first = decoder.rate, decoder.pixel_width, decoder.frame_count
        counts = [first, *(_frame_count(file) for file in self.files[1:])]
        self.frame_count: int | None = sum(counts) if all(counts) else None
        self._is_bare = path.suffix.lower() in BARE
        self._timed_by_fps = self._is_bare and fps is not None
        known = rate if rate > 0.0 else DEFAULT_FPS
        self._note_rate(rate, known, fps)
        self._period_ns = NS_PER_S / (known if fps is None else fps)
        self.camera = self._sidecar_calibration(pixel)
        if unread := [SENSORS[each] for each in _formats(path) if each in SENSORS]:
            self._facts["sensors"] = f"what the sensors measured is not read: {', '.join(unread)}"
        self._damage: list[str] = []

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return video_of(path) is not None

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> VideoFile:
        return cls(path, fps)

    def sources(self) -> dict[str, str]:
        """Sources of times, files, pixels and calibration."""
        return dict(self._facts)

    @property
    def notes(self) -> list[str]:
        """The sources, and what was left out."""
        return [*self._facts.values(), *self._damage]

    def name_of(self, index: int) -> str:
        """The video's name and the frame's number, ``clip.mp4#12``."""
        return f"{printable(self.path.name)}#{index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The frames ``start, start + every, ...`` below ``stop``; always read from the beginning.

        Seeking is left out on purpose: it is inexact in many containers, and times would differ
        from those of a full pass.
        """
        self._damage = []
        clock, index, begins_ms, doubtful = _Clock(self._period_ns), 0, 0.0, 0
        for file in self.files:
            with VideoDecoder(file) as decoder:
                position_ms = 0.0
                while stop is None or index < stop:
                    if not decoder.grab():
                        break
                    position_ms = decoder.position_ms
                    if self._timed_by_fps:
                        position_ms = 1e-6 * self._period_ns * index
                    t_ns = clock.tick(begins_ms + position_ms)
                    if is_asked(index, every, start):
                        frame = self._frame(decoder, index, t_ns)
                        doubtful += isinstance(frame, Dropped)
                        yield frame
                    index += 1
                begins_ms += position_ms + self._period_ns * 1e-6
                self._note_decoding(decoder)
        if stop is None or index < stop:
            self._note_early_end(index)
        if doubtful:
            self._damage.append(
                f"{doubtful} frames of {self.path.name} were left out because they cannot be "
                "decoded without errors"
            )
        if clock.repaired:
            self._damage.append(
                f"{clock.repaired} frame times of {self.path.name} do not increase; they were "
                "set from the frame rate"
            )

    def close(self) -> None:
        """Nothing stays open between passes."""

    def _frame(self, decoder: VideoDecoder, index: int, t_ns: int) -> Frame | Dropped:
        import cv2

        try:
            bgr = decoder.picture()
        except UnreadablePictureError as error:
            return Dropped(index, t_ns, f"{self.name_of(index)} {error}")
        image = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        if image.shape[:2] != (self.height, self.width):
            image = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_CUBIC)
        camera = self.camera or guess_camera(self.width, self.height)
        return Frame(index, t_ns, t_ns, np.asarray(image, np.uint8), camera)

    def _note_rate(self, rate: float, known: float, fps: float | None) -> None:
        if rate > 0.0 and not self._is_bare:
            unused = "" if fps is None else "; --fps is not used"
            note = f"rate: {rate:.6g} pictures a second, from the container{unused}"
        elif fps is not None:
            note = f"rate: {fps:g} pictures a second, from --fps"
        else:
            why = "there is no container" if self._is_bare else "the container states none"
            note = f"rate: {known:.6g} pictures a second was assumed, because {why}; give --fps"
        self._facts["times"] = note
        if len(self.files) > 1:
            names = ", ".join(file.name for file in self.files)
            self._facts["files"] = f"chapters of one recording: {names}"

    def _note_decoding(self, decoder: VideoDecoder) -> None:
        if decoder.deinterlaced_from is not None:
            self._damage.append(
                f"{decoder.path.name} is interlaced from frame {decoder.deinterlaced_from} on; "
                "FFmpeg decodes and deinterlaces it"
            )
        if decoder.complaint:
            self._damage.append(f"the first error in {decoder.path.name}: {decoder.complaint}")

    def _note_early_end(self, read: int) -> None:
        if self.frame_count is not None and read < self.frame_count - COUNT_TOLERANCE:
            self._damage.append(f"the video ends after {read} of {self.frame_count} frames")

    def _sidecar_calibration(self, pixel: float) -> CameraModel | None:
        """The ``camera.yaml`` in the video's folder, if it is for pictures of this shape.

        Sets the size of the pictures: as stored if the calibration is for that, with square pixels
        otherwise.
        """
        file = self.path.parent / CALIBRATION
        camera = load_camera(file) if file.is_file() else None
        if camera is not None and _is_shape_of(camera, self.width, self.height):
            self._facts["calibration"] = f"the calibration is {file}"
            return camera
        stored = f"{self.width} x {self.height}"
        if pixel != 1.0:
            self.width = round(self.width * pixel)
            what = f"{pixel:.4g} wide and 1 high; pictures of {stored} are stretched to"
            stretched = f"{what} {self.width} x {self.height}, from the container"
            self._facts["pixels"] = f"pixels: {stretched}"
        if camera is None:
            return None
        if _is_shape_of(camera, self.width, self.height):
            self._facts["calibration"] = f"the calibration is {file}"
            return camera
        self._facts["calibration"] = (
            f"{file} is not used: it is for pictures of {camera.width} x {camera.height}, those of "
            f"{self.path.name} are {stored}; if it is for the cropped ones, give it with --calib"
        )
        return None


def _is_shape_of(camera: CameraModel, width: int, height: int) -> bool:
    return abs(camera.width / camera.height * height / width - 1.0) <= ASPECT_TOLERANCE


def video_of(path: Path) -> Path | None:
    """``path`` if it is a video, and of a folder without pictures the only one in it, of a GoPro
    recording its first chapter; else None."""
    if not path.is_dir():
        return path if _is_video(path) else None
    with contextlib.suppress(OSError):
        files = sorted(file for file in path.iterdir() if not file.name.startswith("."))
        if (path / SUBFOLDER).is_dir() or any(file.suffix.lower() in PICTURES for file in files):
            return None
        videos = list(filter(_is_video, files))
        if videos and set(_chapters(videos[0])) == set(videos):
            return videos[0]
    return None


def _is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in EXTENSIONS


def _chapters(path: Path) -> list[Path]:
    """The file and, if it is the first chapter of a GoPro recording, the others."""
    files = [path]
    for first, form, second in CHAPTERS:
        match = first.fullmatch(path.name)
        if match is not None:
            others = (
                path.with_name(form.format(*match.groups(), chapter=chapter))
                for chapter in count(second)
            )
            files += takewhile(Path.is_file, others)
    return files


def _formats(path: Path) -> list[bytes]:
    """Of the streams of an MP4; none for other files, and for one that is damaged."""
    return FORMAT.findall(read_index(path) or b"")


def _frame_count(path: Path) -> int:
    with VideoDecoder(path) as decoder:
        return decoder.frame_count


class _Clock:
    """Times since the first frame that strictly increase, whatever the container says."""

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._first_ms: float | None = None
        self._last_ns = -1
        self.repaired = 0
        """Times that did not increase and were set from the frame rate."""

    def tick(self, position_ms: float) -> int:
        """Nanoseconds since the first frame, for a frame that the container puts at a time."""
        if self._first_ms is None:
            self._first_ms = position_ms
            self._last_ns = 0
            return 0
        t_ns = round((position_ms - self._first_ms) * 1e6)
        if t_ns <= self._last_ns:
            t_ns = self._last_ns + round(self._period_ns)
            self.repaired += 1
        self._last_ns = t_ns
        return t_ns
