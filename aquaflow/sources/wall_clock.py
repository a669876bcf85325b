"""The computer's own clock as a source of UTC, so that a recording holds what a live dive heard."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from aquaflow.base.clocks.wall import WallClockWatch
from aquaflow.types import UtcTime

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
