"""Where frames and telemetry come from: the protocols, and the registry of those installed.

A source is a class behind the entry point group ``aquaflow.cameras`` (or ``aquaflow.telemetry``),
so that a site can add its own without touching this package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.config.cameras import CameraConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.telemetry import TelemetryConfig
from aquaflow.types import CameraModel, Dropped, Frame, TelemetrySample

CAMERAS = "aquaflow.cameras"
"""Group of entry points whose classes are cameras, live or recorded."""
TELEMETRY = "aquaflow.telemetry"
"""Group of entry points whose classes read telemetry."""
LINKS = "links"
"""The entry point of live telemetry; the others of its group read recordings."""

RawTap: TypeAlias = Callable[[str, int, bytes], None]
"""Gets every read of a link as it came: name of the link, arrival_ns, bytes. Must not block."""


@runtime_checkable
class CameraSource(Protocol):
    """Yields frames in the order of their exposure."""

    camera: CameraModel | None
    """Calibration that comes with the recording, if any."""
    frame_count: int | None
    """Number of frames, where the source knows it."""

    @property
    def notes(self) -> list[str]:
        """Sentences for the user about what was read, assumed and left out, complete once
        iteration ends."""
        ...

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """Frames whose index is ``start, start + every, ...`` below ``stop``."""
        ...

    def close(self) -> None: ...


def is_asked(index: int, every: int, start: int) -> bool:
    """True for the indices ``start, start + every, ...`` of :meth:`CameraSource.frames`."""
    return index >= start and (index - start) % every == 0


@runtime_checkable
class StatesMounting(Protocol):
    """A source of frames that knows how its camera sits in the vehicle."""

    def stated_mounting(self) -> MountingConfig | None:
        """Stated mounting of the camera in the body; None if it is not stated.

        Raises:
            InputError, ConfigError: what states it cannot be read.
        """
        ...


def mounting_of(camera: object) -> MountingConfig | None:
    """The mounting that a source states, if it is one that can.

    Raises:
        InputError, ConfigError: as of :meth:`StatesMounting.stated_mounting`.
    """
    return camera.stated_mounting() if isinstance(camera, StatesMounting) else None


class RecordedCamera(CameraSource, Protocol):
    """A camera source that opens something recorded on disk."""

    specificity: int
    """Where several sources recognise a path, the highest opens it: a synthetic dive is also a
    folder of images."""

    def name_of(self, index: int) -> str:
        """The file name of a frame, or ``clip.mp4#123``."""
        ...

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True if this class is the right reader for ``path``."""
        ...

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> RecordedCamera:
        """Open ``path``; ``fps`` sets the frame times where the recording has none.

        Raises:
            InputError: the recording cannot be read at all.
        """
        ...


@runtime_checkable
class TopicReader(Protocol):
    """A recorded camera whose recordings may hold pictures on several topics."""

    @classmethod
    def topic_of(cls, path: Path, topic: str) -> RecordedCamera:
        """Open the pictures on ``topic``.

        Raises:
            InputError: the recording has no pictures there.
        """
        ...


class LiveSource(CameraSource, Protocol):
    """A camera source that opens a device; ``frames`` yields the newest picture until ``close``."""

    @classmethod
    def from_config(cls, name: str, config: Any) -> LiveSource:
        """The camera that ``config`` of this driver's kind describes; opens nothing yet."""
        ...

    def connect(self) -> None:
        """Open the device now; without it, ``frames`` waits until the device is there.

        Raises:
            InputError: the device is not there or refuses.
        """
        ...


class TelemetrySource(Protocol):
    """Yields telemetry in the order of arrival."""

    def samples(self) -> Iterator[TelemetrySample]: ...

    def close(self) -> None: ...


class RecordedTelemetry(TelemetrySource, Protocol):
    """A telemetry source that opens something recorded on disk; every pass begins anew."""

    specificity: int
    """As of :class:`RecordedCamera`."""

    @property
    def notes(self) -> list[str]:
        """Sentences for the user about what was left out, complete once iteration ends."""
        ...

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True if this class is the right reader for ``path``."""
        ...

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> RecordedTelemetry:
        """Open ``path``, whose clock begins ``starts_s`` after the caller's.

        Raises:
            InputError: the recording cannot be read at all.
        """
        ...


@runtime_checkable
class RefusesFiles(Protocol):
    """A reader of telemetry that knows why it cannot read a file of its kind."""

    @classmethod
    def refusal(cls, path: Path) -> str | None:
        """One sentence with the cause and what to do; None for a file of another kind."""
        ...


@runtime_checkable
class StatesSources(Protocol):
    """A recorded camera that says where what it reads comes from, and what it assumes."""

    def sources(self) -> dict[str, str]:
        """A sentence on each of ``times``, ``calibration``, ``white``, ``pixels``, ``topic`` and
        so on, as far as there is something to say; ``notes`` holds them too."""
        ...


def sources_of(camera: object) -> dict[str, str]:
    """What a camera states of its sources, if it is one that can."""
    return camera.sources() if isinstance(camera, StatesSources) else {}


GIVEN = "the calibration is the one that was given (--calib)"
"""Source of a calibration that is not the recording's own."""


def notes_with(recording: RecordedCamera, calibration: CameraModel | None) -> list[str]:
    """The notes of a recording that is mapped with ``calibration``: where that is not its own, what
    became of its own does not matter."""
    own = sources_of(recording).get("calibration")
    if calibration is None or calibration is recording.camera or own is None:
        return list(recording.notes)
    return [GIVEN if note == own else note for note in recording.notes]


@runtime_checkable
class FollowsPictures(Protocol):
    """Recorded telemetry whose clock begins with the first picture of its own recording."""

    def follow(self, fps: float | None, topic: str | None) -> None:
        """Which pictures those are, as of :func:`open_recording`."""
        ...


def open_recording(
    path: Path, fps: float | None = None, topic: str | None = None
) -> RecordedCamera:
    """Open whatever lies at ``path`` with the first registered source that recognises it; of a
    recording with several picture topics, ``topic``.

    Raises:
        ArgumentError: ``fps`` is no rate.
        InputError: nothing is there, or no installed source reads it.
    """
    if fps is not None and not (math.isfinite(fps) and fps > 0.0):
        raise ArgumentError(f"a frame rate of {fps:g} pictures a second is not above zero")
    if not path.exists():
        raise InputError(f"there is nothing at {path}; give a folder of images or a video file")
    reader = camera_reader(path)
    if topic is not None and fps is not None:
        raise InputError(f"{path} has times of its own on {topic}; leave out --fps")
    if reader is not None and topic is not None:
        if not isinstance(reader, TopicReader):
            raise InputError(f"{path} has no topics; leave out --topic")
        return reader.topic_of(path, topic)
    if reader is not None:
        return reader.open(path, fps=fps)
    names = ", ".join(sorted(entry.name for entry in entry_points(group=CAMERAS)))
    known = names or "none; reinstall aquaflow"
    raise InputError(f"no installed source reads {path}; installed sources are: {known}")


def camera_reader(path: Path) -> type[RecordedCamera] | None:
    """The registered source that recognises ``path`` best; None if it is no recording."""
    reader: type[RecordedCamera] | None = _best_reader(CAMERAS, path)
    return reader


def open_camera(name: str, config: CameraConfig) -> LiveSource:
    """The live camera that ``config`` describes, behind the entry point named as its ``kind``.

    Raises:
        InputError: no driver of this kind is installed.
        ConfigError: the calibration that ``config`` names is malformed.
    """
    for entry in entry_points(group=CAMERAS):
        if entry.name == config.kind:
            driver: type[LiveSource] = entry.load()
            return driver.from_config(name, config)
    raise InputError(f"no driver for cameras of kind '{config.kind}'; reinstall aquaflow")


def open_links(config: TelemetryConfig, tap: RawTap | None = None) -> TelemetrySource:
    """The live telemetry devices of ``config``; ``tap`` gets the raw bytes of every link.

    Raises:
        InputError: no driver for links is installed, or a library that one needs.
        ConfigError: a DBC file is not as the config says.
    """
    for entry in entry_points(group=TELEMETRY):
        if entry.name == LINKS:
            driver: Callable[[TelemetryConfig, RawTap | None], TelemetrySource] = entry.load()
            return driver(config, tap)
    raise InputError("no driver for telemetry links is installed; reinstall aquaflow")


def open_recorded_telemetry(path: Path, starts_s: float = 0.0) -> RecordedTelemetry:
    """Open the telemetry at ``path`` with the registered source that recognises it best.

    Raises:
        InputError: nothing is there, or no installed source finds telemetry in it.
    """
    found = telemetry_reader(path)
    if found is None:
        reasons = [
            cls.refusal(path) for cls in _readers(TELEMETRY) if issubclass(cls, RefusesFiles)
        ]
        why = next((reason for reason in reasons if reason is not None), None)
        raise InputError(why or f"no installed source finds telemetry in {path}")
    return found.open(path, starts_s)


def telemetry_reader(path: Path) -> type[RecordedTelemetry] | None:
    """The registered source that recognises ``path`` best; None if it holds no telemetry."""
    if not path.exists():
        raise InputError(f"there is nothing at {path}; give a recording with telemetry")
    reader: type[RecordedTelemetry] | None = _best_reader(TELEMETRY, path)
    return reader


def _best_reader(group: str, path: Path) -> Any:
    """Of the entry points of ``group``, the class of highest specificity that recognises it."""
    readers = [cls for cls in _readers(group) if hasattr(cls, "recognises")]
    fitting = [cls for cls in readers if cls.recognises(path)]
    return max(fitting, key=lambda cls: cls.specificity) if fitting else None


def _readers(group: str) -> list[Any]:
    entries = sorted(entry_points(group=group), key=lambda entry: entry.name)
    return [entry.load() for entry in entries]
