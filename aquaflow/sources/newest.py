"""A bounded queue between threads: producers never wait, a new item displaces the oldest."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from aquaflow.base.clocks.wall import WallClockWatch
from aquaflow.base.errors.failures import Failures
from aquaflow.config import SourceConfig
from aquaflow.types import Dropped, Frame, TelemetrySample, UtcTime

Item = TypeVar("Item")


class Newest(Generic[Item]):
    """Holds the newest item, or the ``longest`` newest; many producers, one consumer."""

    def __init__(
        self, longest: int = 1, discard: Callable[[Item], object] = lambda item: None
    ) -> None:
        """``discard`` is called for each item that is displaced or comes after the end; one call at
        a time, in the thread that puts or ends."""
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._longest, self._discard = longest, discard
        self._asked = False
        self._ended = False
        self.overtaken = 0
        """Items that were discarded."""

    def put(self, item: Item) -> None:
        """Add ``item``; after the end it is discarded."""
        self.put_all([item])

    def put_all(self, items: Iterable[Item]) -> None:
        """Offer ``items``, the oldest first."""
        with self._changed:
            if self._ended:
                self._overtake(deque(items), 0)
                return
            self._items.extend(items)
            self._asked = self._asked and not self._items
            self._overtake(self._items, self._longest)
            self._changed.notify_all()

    def take(self, timeout_s: float | None = None) -> Item | None:
        """Wait for the oldest item; None once the queue has ended and is empty, or after
        ``timeout_s`` without an item."""
        with self._changed:
            self._asked = not self._items
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._items or self._ended, timeout_s)
            self._asked = not self._items  # after a timeout the consumer comes again
            return self._items.popleft() if self._items else None

    def wait_for_consumer(self, timeout_s: float) -> bool:
        """Wait until a consumer waits, so that items can be produced on demand."""
        with self._changed:
            return self._changed.wait_for(lambda: self._asked or self._ended, timeout_s)

    def end(self, discard: bool = False) -> None:
        """Accept no more items and wake all waiting threads; items already held can still be taken,
        unless ``discard``."""
        with self._changed:
            self._ended = True
            if discard:
                self._overtake(self._items, 0)
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """True once nothing is left and nothing will come."""
        with self._changed:
            return self._ended and not self._items

    def _overtake(self, items: deque[Item], longest: int) -> None:
        while len(items) > longest:
            self.overtaken += 1
            self._discard(items.popleft())


# --------------------------------------------------------------------------------------------------
# Reads a recording past frames on which its reader raises; only these frames are lost.

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


# --------------------------------------------------------------------------------------------------
# The computer's own clock as a source of UTC, so that a recording holds what a live dive heard.

SOURCE = "computer/clock"
"""Name of the samples' source."""
EVERY_S = 10.0
"""A computer's clock drifts by 1e-4 at most: 1 ms."""
OLDEST_NS = 1_735_689_600 * 1_000_000_000
"""2025-01-01: a clock from before this program existed was never set."""


class WallClock:
    """Yields the wall clock every ``every_s`` until it is closed, as the computer has it: after it
    was set, as it is then."""

    def __init__(self, every_s: float = EVERY_S) -> None:
        self._every_s = every_s
        self._closed = threading.Event()
        self._watch = WallClockWatch()

    def samples(self) -> Iterator[UtcTime]:
        """The first at once; none while the computer's clock was never set."""
        while not self._closed.is_set():
            now = self._watch.read()
            t_ns, utc_ns = now.monotonic_ns, now.monotonic_ns + now.offset_ns
            if utc_ns >= OLDEST_NS:
                yield UtcTime(t_ns, t_ns, SOURCE, utc_ns)
            self._closed.wait(self._every_s)

    def close(self) -> None:
        """End the samples."""
        self._closed.set()
