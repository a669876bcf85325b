"""A recording whose reader raises: that costs the frame it raised on, not the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from aquaflow.config import SourceConfig
from aquaflow.errors.failures import Failures
from aquaflow.messages import Dropped, Frame, TelemetrySample

Event = TypeVar("Event", bound=Frame | Dropped | TelemetrySample)

MOST_UNREADABLE = 5
"""Frames in a row that a recording fails on until the rest is given up."""


def read_on(
    read: Callable[[int], Iterator[Event]],
    start: int,
    source: SourceConfig,
    frame_count: int | None,
    failures: Failures,
    give_up: Callable[[int], object],
) -> Iterator[Event | Dropped]:
    """What ``read(start)`` yields; after a frame that it raises on, reading goes on with the next.

    ``give_up`` is called with the frame at which one too many in a row could not be read.

    Raises:
        Exception: the recording fails before its first frame; whatever its reader raised.
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
