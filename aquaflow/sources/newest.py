"""A bounded queue between threads: producers never wait, a new item displaces the oldest."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

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
