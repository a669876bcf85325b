"""Where frames and telemetry come from: the protocols, and the registry of those installed.

A source is a class behind the entry point group ``aquaflow.cameras`` (or ``aquaflow.telemetry``),
so that a site can add its own without touching this package.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, runtime_checkable

from aquaflow.errors import InputError
from aquaflow.messages import CameraModel, Dropped, Frame, TelemetrySample

CAMERAS = "aquaflow.cameras"
TELEMETRY = "aquaflow.telemetry"


@runtime_checkable
class CameraSource(Protocol):
    """Yields frames in the order of their exposure."""

    camera: CameraModel | None
    """Calibration that comes with the recording, if any."""
    frame_count: int | None
    """Number of frames, where the source knows it."""
    notes: list[str]
    """Sentences for the user about what was left out, complete once iteration ends."""

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """Frames whose index is ``start, start + every, ...`` below ``stop``."""
        ...

    def close(self) -> None: ...


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


class TelemetrySource(Protocol):
    """Yields telemetry in the order of arrival."""

    def samples(self) -> Iterator[TelemetrySample]: ...

    def close(self) -> None: ...


def open_recording(path: Path, fps: float | None = None) -> RecordedCamera:
    """Open whatever lies at ``path`` with the first registered source that recognises it.

    Raises:
        InputError: nothing is there, or no installed source reads it.
    """
    if not path.exists():
        raise InputError(f"there is nothing at {path}; give a folder of images or a video file")
    entries = sorted(entry_points(group=CAMERAS), key=lambda entry: entry.name)
    readers: list[type[RecordedCamera]] = [entry.load() for entry in entries]
    fitting = [cls for cls in readers if hasattr(cls, "recognises") and cls.recognises(path)]
    if fitting:
        return max(fitting, key=lambda cls: cls.specificity).open(path, fps=fps)
    names = ", ".join(entry.name for entry in entries) or "none; reinstall aquaflow"
    raise InputError(f"no installed source reads {path}; installed sources are: {names}")
