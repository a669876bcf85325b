"""The telemetry that a replay is given: what is on the recording's clock, and what is not yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from aquaflow.base.errors import ArgumentError
from aquaflow.sources import (
    FollowsPictures,
    RecordedTelemetry,
    open_recorded_telemetry,
    telemetry_reader,
)


@dataclass(frozen=True)
class TelemetryInput:
    """Opened sources of telemetry; nothing has been read of them."""

    synchronised: Sequence[RecordedTelemetry] = ()
    """On the recording's clock."""
    unsynchronised: Mapping[str, RecordedTelemetry] = field(default_factory=dict)
    """By file name: logs on a clock of their own."""

    @property
    def notes(self) -> list[str]:
        """Sentences of every source about what was left out, complete once it has been read."""
        return [
            note
            for source in (*self.synchronised, *self.unsynchronised.values())
            for note in source.notes
        ]

    def close(self) -> None:
        """Close every source."""
        for source in (*self.synchronised, *self.unsynchronised.values()):
            source.close()


def open_telemetry(
    recording: Path | None,
    logs: Sequence[Path] = (),
    offset_s: float | None = None,
    fps: float | None = None,
    topic: str | None = None,
) -> TelemetryInput:
    """The telemetry that the recording brings itself, if it lies on disk, and ``logs`` beside it.

    ``offset_s`` is when every log begins, in seconds after the recording's first picture; None if
    that is not known. ``fps`` and ``topic`` are those by which the recording was opened.

    Raises:
        InputError: a log is missing, or no installed source finds telemetry in it.
        ArgumentError: an offset was given without a log.
    """
    if offset_s is not None and not logs:
        raise ArgumentError(
            "--telemetry-offset says when a log begins; give the log by --telemetry"
        )
    reader = None if recording is None else telemetry_reader(recording)
    own = [] if reader is None or recording is None else [reader.open(recording)]
    for each in own:
        if isinstance(each, FollowsPictures):
            each.follow(fps, topic)
    if offset_s is not None:
        opened = [open_recorded_telemetry(log, offset_s) for log in logs]
        return TelemetryInput(synchronised=[*own, *opened])
    return TelemetryInput(own, {str(log): open_recorded_telemetry(log) for log in logs})
