"""A queue between threads in which the newest win: nobody who puts waits, the oldest give way."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

Thing = TypeVar("Thing")


class Newest(Generic[Thing]):
    """Holds one thing, or the ``longest`` newest; many threads may put, one takes."""

    def __init__(
        self, longest: int = 1, let_go: Callable[[Thing], object] = lambda thing: None
    ) -> None:
        """``let_go`` is called for each thing that gives way or comes after the end; one call at a
        time, in the thread that puts or ends."""
        self._changed = threading.Condition()
        self._things: deque[Thing] = deque()
        self._longest, self._let_go = longest, let_go
        self._asked = False
        self._ended = False
        self.overtaken = 0
        """Things that were let go."""

    def put(self, thing: Thing) -> None:
        """Offer ``thing``; after the end there is no room for it."""
        self.put_all([thing])

    def put_all(self, things: Iterable[Thing]) -> None:
        """Offer ``things``, the oldest first."""
        with self._changed:
            if self._ended:
                self._overtake(deque(things), 0)
                return
            self._things.extend(things)
            self._asked = self._asked and not self._things
            self._overtake(self._things, self._longest)
            self._changed.notify_all()

    def take(self, timeout_s: float | None = None) -> Thing | None:
        """The oldest thing that is held, waited for; None once the queue has ended and is empty,
        or if ``timeout_s`` passed without one."""
        with self._changed:
            self._asked = not self._things
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._things or self._ended, timeout_s)
            self._asked = not self._things  # whoever got nothing will come again
            return self._things.popleft() if self._things else None

    def asked(self, timeout_s: float) -> bool:
        """Wait until somebody waits for a thing: what is made only then is as new as can be."""
        with self._changed:
            return self._changed.wait_for(lambda: self._asked or self._ended, timeout_s)

    def end(self, discard: bool = False) -> None:
        """Accept no more, and wake whoever waits; what is held can still be taken, or is let go
        with ``discard``."""
        with self._changed:
            self._ended = True
            if discard:
                self._overtake(self._things, 0)
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """True once nothing is left and nothing will come."""
        with self._changed:
            return self._ended and not self._things

    def _overtake(self, things: deque[Thing], longest: int) -> None:
        while len(things) > longest:
            self.overtaken += 1
            self._let_go(things.popleft())
