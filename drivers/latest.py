"""A bounded queue between the links and whoever fetches samples: the oldest give way."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class LatestQueue(Generic[Item]):
    """Many threads put, one takes; nobody who puts ever waits."""

    def __init__(self, longest: int, overtaken: Callable[[Item], None]) -> None:
        """``overtaken`` is called for each item that gives way; one call at a time."""
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._longest = longest
        self._overtaken = overtaken
        self._ended = False

    def put(self, items: list[Item]) -> None:
        """Append ``items``; after the end there is no room for them."""
        with self._changed:
            self._items.extend(items)
            longest = 0 if self._ended else self._longest
            while len(self._items) > longest:
                self._overtaken(self._items.popleft())
            self._changed.notify_all()

    def take(self) -> Item | None:
        """The oldest item, waited for; None once the queue has ended and is empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._ended)
            return self._items.popleft() if self._items else None

    def end(self) -> None:
        """Accept no more; what waits can still be taken."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
