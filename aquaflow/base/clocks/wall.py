"""The computer's wall clock, which jumps during dives. Nothing but the log depends on it; what must
end in time follows the monotonic one (deadline.py)."""

from __future__ import annotations

import ctypes
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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


# --------------------------------------------------------------------------------------------------
# Whether the computer's clock can be believed: a board without a battery wakes up in the past.

SYNCHRONISED = Path("run/systemd/timesync/synchronized")
"""systemd-timesyncd(8) makes it when it first hears a time server after a boot."""
BATTERY_CLOCKS = "sys/class/rtc/rtc*/since_epoch"
"""Clocks with a battery of their own, in seconds since 1970 (Documentation/admin-guide/rtc.rst)."""
AGREE_S = 60.0
"""The kernel takes its time from such a clock at the boot, in whole seconds, and writes it back
every 11 minutes; one that differs by more did not set this clock."""
TIME_ERROR = 5
"""What adjtimex(2) returns while nothing has synchronised the kernel's clock."""
TIMEX_BYTES = 512
"""More than a struct timex has (208 on 64-bit systems); zeros ask without changing anything."""


def clock_is_set(root: Path = Path("/"), now_s: Callable[[], float] = time.time) -> bool:
    """True if the wall clock was set since the machine was started: by a time server or GNSS, or
    by a clock with a battery that it agrees with."""
    if (root / SYNCHRONISED).exists():
        return True
    found = (_seconds(clock) for clock in root.glob(BATTERY_CLOCKS))
    if any(seconds is not None and abs(seconds - now_s()) <= AGREE_S for seconds in found):
        return True
    return root == Path("/") and kernel_is_synchronised()


def kernel_is_synchronised() -> bool:
    """What adjtimex(2) says; False where a sandbox forbids to ask."""
    try:
        answer = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX_BYTES))
    except (AttributeError, OSError):
        return False
    return 0 <= int(answer) < TIME_ERROR


def _seconds(clock: Path) -> int | None:
    try:
        return int(clock.read_text())
    except (OSError, ValueError):
        return None
