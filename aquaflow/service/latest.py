"""A queue of one item between producer and consumer: the newest wins."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

Thing = TypeVar("Thing")


class Newest(Generic[Thing]):
    """The newest wins; one that nobody took is counted and let go. Nobody who puts ever waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._thing: Thing | None = None
        self._asked = False
        self._ended = False
        self.overtaken = 0
        """Things that nobody took because a newer one came first."""

    def put(self, thing: Thing) -> None:
        """Offer ``thing``."""
        with self._changed:
            self.overtaken += self._thing is not None
            self._thing, self._asked = thing, False
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Thing | None:
        """The newest thing; None if ``timeout_s`` passed without one."""
        with self._changed:
            self._asked = self._thing is None
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._thing is not None or self._ended, timeout_s)
            thing, self._thing = self._thing, None
            self._asked = thing is None  # whoever got nothing will come again
            return thing

    def asked(self, timeout_s: float) -> bool:
        """Wait until somebody waits for a thing: what is made only then is as new as can be."""
        with self._changed:
            return self._changed.wait_for(lambda: self._asked or self._ended, timeout_s)

    def end(self) -> None:
        """No more will come; whoever waits wakes."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """True once nothing is left and nothing will come."""
        with self._changed:
            return self._ended and self._thing is None
