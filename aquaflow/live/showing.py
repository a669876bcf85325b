"""A thread that shows a running dive to those who look on; what fails there costs it nothing."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

LOOK_S = 0.1
"""Longest that ``show`` may wait for something new; then it is looked whether the thread shall
end."""
ENDING_S = 5.0
"""Longest wait for the thread's end; what it shows to may hang."""


class Showing:
    """Calls ``show`` again and again in a thread of its own."""

    def __init__(self, name: str, show: Callable[[], None], pause_s: float) -> None:
        """``pause_s``: after a failure, which is logged."""
        self._name, self._show, self._pause_s = name, show, pause_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join(ENDING_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._show()
            except Exception:  # whatever somebody did who looks on, the dive goes on
                log.exception("the dive could not be shown: %s", self._name)
                self._closing.wait(self._pause_s)
