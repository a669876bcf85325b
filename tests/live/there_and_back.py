"""What a simulated camera sees in a test: the same place, for as long as the test takes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from aquaflow.sources import open_recording
from aquaflow.types import CameraModel, Frame

PLACE = 8
"""Pictures that all see the same place: a machine that takes only some of them stays on course."""


class ThereAndBack:
    """The begin of a recording forwards and backwards, for ever: no place changes at once."""

    camera: CameraModel | None = None
    frame_count: int | None = None

    def __init__(self, recording: Path, stop: int = PLACE) -> None:
        source = open_recording(recording)
        frames = source.frames(stop=stop)
        self._seen = [frame for frame in frames if isinstance(frame, Frame)]
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        yield from self._seen
        yield from self._seen[-2:0:-1]

    def close(self) -> None: ...
