"""Reads a recording past frames on which its reader raises; only these frames are lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from aquaflow.base.errors.failures import Failures
from aquaflow.config import SourceConfig
from aquaflow.types import Dropped, Frame, TelemetrySample

Event = TypeVar("Event", bound=Frame | Dropped | TelemetrySample)

MOST_UNREADABLE = 5
"""Frames in a row that a recording fails on until the rest is given up."""


def read_past_failures(
    read: Callable[[int], Iterator[Event]],
    start: int,
    source: SourceConfig,
    frame_count: int | None,
    failures: Failures,
    give_up: Callable[[int], object],
) -> Iterator[Event | Dropped]:
    """Events of ``read(start)``; after a frame on which it raises, reading continues with the next.

    ``give_up`` is called with the next frame after ``MOST_UNREADABLE`` failures in a row.

    Raises:
        Exception: the error of the reader, if the recording fails before its first frame.
    """
    ends = [end for end in (frame_count, source.stop) if end is not None]
    t_ns, failed_in_a_row, any_read = 0, 0, False
    events = read(start)
    while failed_in_a_row < MOST_UNREADABLE:
        with failures.contain("reading", start) as reading:
            event = next(events, None)
        if reading.error is not None:
            if not any_read:
                raise reading.error
            if ends and start >= min(ends):
                return  # closing failed after the last frame
            failed_in_a_row += 1
            yield Dropped(start, t_ns, "reading failed, see log.jsonl")
            start += source.every
            events = read(start)
            continue
        if event is None:
            return
        if isinstance(event, (Frame, Dropped)):
            any_read, failed_in_a_row = True, 0
            start, t_ns = event.index + source.every, event.t_ns
        yield event
    give_up(start)
