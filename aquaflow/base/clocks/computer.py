"""Whether the computer's clock can be believed: a board without a battery wakes up in the past."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from pathlib import Path

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
    """As adjtimex(2) says; False where a sandbox forbids to ask."""
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
