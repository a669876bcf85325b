"""``replay.yaml``: a camera's recording and the telemetry logs that were recorded with it.

    camera: dive.mp4
    mounting: {pitch_deg: -90}
    telemetry:
      - {file: dive.tlog, starts_s: -3.2}
      - file: sounder.nmea
        device: {kind: nmea0183, link: {port: log}, depth_sentences: [DBT]}

``mounting`` is the camera's in the vehicle, as in a vehicle's configuration. ``starts_s`` is when
the log begins, in seconds after the first picture.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

from pydantic import Field

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.config.stage import MountingConfig, StageConfig, validate
from aquaflow.config.telemetry import AnyDevice
from aquaflow.recordings.telemetry_log import ByteLog
from aquaflow.sources import (
    RawTap,
    RecordedCamera,
    RecordedTelemetry,
    open_recorded_telemetry,
    open_recording,
    sources_of,
)
from aquaflow.types import Dropped, Frame, TelemetrySample

MANIFEST = "replay.yaml"
"""File that makes a folder a recording of several files."""
MOST_S = 1e9
"""30 years between a log's beginning and the first picture: clocks that were never set."""


class LogEntry(StageConfig):
    """One telemetry log."""

    file: str
    starts_s: float = Field(0.0, ge=-MOST_S, le=MOST_S)
    device: AnyDevice | None = None
    """What speaks in a log of bytes; None: the usual for its kind."""


class Manifest(StageConfig):
    """What lies in the folder."""

    camera: str | None = None
    mounting: MountingConfig | None = None
    """Of the camera; None: as its own file states it, else unknown."""
    telemetry: tuple[LogEntry, ...] = ()


def read_manifest(folder: Path) -> Manifest:
    """The folder's ``replay.yaml``.

    Raises:
        InputError: it cannot be read.
        ConfigError: a key is unknown or a value out of range.
    """
    path = folder / MANIFEST
    data = read_mapping(path, "list of logs", "write `camera:` and `telemetry:` lines")
    return validate(Manifest, data, str(path))


class ManifestCamera:
    """The camera that a manifest names, opened by the reader of its own format."""

    specificity = 3

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / MANIFEST).is_file()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> RecordedCamera:
        """Raises InputError if the manifest names no camera, or nothing reads it."""
        manifest = read_manifest(path)
        if manifest.camera is None:
            raise InputError(f"{path / MANIFEST} names no camera")
        camera = open_recording(_named_file(path, manifest.camera), fps)
        return camera if manifest.mounting is None else MountedCamera(camera, manifest.mounting)


class MountedCamera:
    """A recorded camera whose mounting is stated outside of its own file."""

    def __init__(self, recording: RecordedCamera, mounting: MountingConfig) -> None:
        self._recording, self._mounting = recording, mounting
        self.specificity = recording.specificity
        self.camera, self.frame_count = recording.camera, recording.frame_count

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return ManifestCamera.recognises(path)

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> RecordedCamera:
        """Raises InputError as :meth:`ManifestCamera.open` does."""
        return ManifestCamera.open(path, fps)

    @property
    def notes(self) -> list[str]:
        return self._recording.notes

    def sources(self) -> dict[str, str]:
        """Sources of what the recording itself states."""
        return sources_of(self._recording)

    def stated_mounting(self) -> MountingConfig:
        """The mounting as the manifest states it."""
        return self._mounting

    def name_of(self, index: int) -> str:
        return self._recording.name_of(index)

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        return self._recording.frames(every, start, stop)

    def close(self) -> None:
        self._recording.close()


class ManifestTelemetry:
    """All logs that a manifest names, merged in the order of arrival."""

    specificity = 3

    def __init__(self, folder: Path, starts_s: float = 0.0) -> None:
        """Raises InputError or ConfigError where the manifest or a log cannot be used."""
        self.logs = [_log(folder, entry, starts_s) for entry in read_manifest(folder).telemetry]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return ManifestCamera.recognises(path)

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> ManifestTelemetry:
        return cls(path, starts_s)

    @property
    def notes(self) -> list[str]:
        return [note for log in self.logs for note in log.notes]

    def tap_bytes(self, tap: RawTap) -> None:
        """Hand the bytes of every log of bytes to ``tap`` as well."""
        for log in self.logs:
            if isinstance(log, ByteLog):
                log.tap_bytes(tap)

    def samples(self) -> Iterator[TelemetrySample]:
        """Samples of all logs; of equal arrivals those of the log named first."""
        streams = [log.samples() for log in self.logs]
        return heapq.merge(*streams, key=lambda sample: sample.arrival_ns)

    def close(self) -> None:
        for log in self.logs:
            log.close()


def _named_file(folder: Path, name: str) -> Path:
    """What the folder's manifest names.

    Raises:
        InputError: that has a manifest too, perhaps this one: following them might never end.
    """
    path = folder / name
    if ManifestCamera.recognises(path):
        raise InputError(f"{folder / MANIFEST} names {path}, which has a {MANIFEST} of its own")
    return path


def _log(folder: Path, entry: LogEntry, starts_s: float) -> RecordedTelemetry:
    path = _named_file(folder, entry.file)
    log = open_recorded_telemetry(path, entry.starts_s + starts_s)
    if entry.device is None:
        return log
    if not isinstance(log, ByteLog):
        raise ConfigError(f"{path} is no log of bytes; it takes no `device`")
    return type(log)(path, entry.starts_s + starts_s, entry.device)
