"""The wall clock, watched: it jumps during dives, and nothing but the log depends on it."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

log = logging.getLogger(__name__)

JUMP_NS = 500_000_000
"""NTP slews by 0.5 ms/s; more than this between two readings is a clock being set."""


@dataclass(frozen=True)
class WallClockReading:
    """Both clocks, read at the same moment."""

    monotonic_ns: int
    offset_ns: int
    """CLOCK_REALTIME minus CLOCK_MONOTONIC."""
    jump_ns: int
    """Change since the previous reading, if that is a jump; else 0."""


class WallClockWatch:
    """Offset of the wall clock as a series; jumps are counted and logged, and do nothing else."""

    def __init__(self, tell: bool = True) -> None:
        """``tell``: log jumps; of several watches one does."""
        self.jumps = 0
        self._tell = tell
        self._last_offset_ns: int | None = None

    def read(
        self, monotonic_ns: int | None = None, realtime_ns: int | None = None
    ) -> WallClockReading:
        """Read both clocks; a recording passes its own values instead."""
        monotonic = time.monotonic_ns() if monotonic_ns is None else monotonic_ns
        realtime = time.time_ns() if realtime_ns is None else realtime_ns
        offset = realtime - monotonic
        change = 0 if self._last_offset_ns is None else offset - self._last_offset_ns
        self._last_offset_ns = offset
        if abs(change) < JUMP_NS:
            return WallClockReading(monotonic, offset, 0)
        self.jumps += 1
        if self._tell:
            log.warning(
                "the wall clock was set by %+.3f s; the dive's clock goes on", change * 1e-9,
                extra={"fields": {"event": "clock", "source": "computer"}},
            )  # fmt: skip
        return WallClockReading(monotonic, offset, change)
