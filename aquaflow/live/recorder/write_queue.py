"""The queue of what is to be written, bounded in bytes: a slow disk costs data, not the dive."""

from __future__ import annotations

import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import TypeAlias

from aquaflow.types import Dropped, Frame, TelemetrySample

SAMPLE_BYTES = 400
"""A telemetry sample in memory, about."""


@dataclass(frozen=True)
class QueuedPicture:
    """A frame of a camera, or the note that one is missing."""

    camera: str
    frame: Frame | Dropped

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/{self.camera}"

    @property
    def size(self) -> int:
        """Bytes that it takes in memory."""
        if isinstance(self.frame, Dropped):
            return SAMPLE_BYTES
        received = 0 if self.frame.encoded is None else len(self.frame.encoded.data)
        return self.frame.image.nbytes + received


@dataclass(frozen=True)
class QueuedSample:
    """A decoded telemetry sample."""

    sample: TelemetrySample
    size: int = SAMPLE_BYTES

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/telemetry/{self.sample.source}"


@dataclass(frozen=True)
class LinkBytes:
    """What one read of a link returned."""

    link: str
    arrival_ns: int
    data: bytes

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/links/{self.link}"

    @property
    def size(self) -> int:
        """Bytes that it takes in memory."""
        return SAMPLE_BYTES + len(self.data)


Item: TypeAlias = QueuedPicture | QueuedSample | LinkBytes


class WriteQueue:
    """A queue whose producers never wait: what does not fit is dropped and counted."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._items: deque[Item] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._changed = threading.Condition()

    def put(self, item: Item) -> bool:
        """Queue ``item``; False if there is no room for it."""
        with self._changed:
            if self._bytes + item.size > self._limit:
                self._dropped[item.topic] += 1
                return False
            self._items.append(item)
            self._bytes += item.size
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> Item | None:
        """The oldest item; None if ``timeout_s`` passed without one, or :meth:`wake` was called."""
        with self._changed:
            if not self._items:
                self._changed.wait(max(timeout_s, 0.0))
            if not self._items:
                return None
            item = self._items.popleft()
            self._bytes -= item.size
            return item

    def wake(self) -> None:
        """Let :meth:`take` return."""
        with self._changed:
            self._changed.notify_all()

    def refuse(self, topic: str) -> None:
        """Count an item of ``topic`` that was taken but could not be written."""
        with self._changed:
            self._dropped[topic] += 1

    def drop(self) -> dict[str, int]:
        """Dropped items by topic."""
        with self._changed:
            return dict(self._dropped)
