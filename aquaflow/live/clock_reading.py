"""The dive's clock across a restart: CLOCK_MONOTONIC restarts with every boot."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""Changes with every start of the kernel, and with it the zero of the monotonic clock."""
LEAST_GAP_NS = 1_000_000_000
"""From the last moment before another boot to the first after it, if the wall clock gives less."""


@dataclass(frozen=True)
class ClockReading:
    """A moment on both clocks, and which boot it belongs to."""

    monotonic_ns: int
    wall_ns: int
    boot: str
    dive_shift_ns: int = 0
    """From the monotonic clock to the dive's; the dive may have begun before another boot."""

    @property
    def dive_ns(self) -> int:
        """On the dive's clock."""
        return self.monotonic_ns + self.dive_shift_ns

    @staticmethod
    def now(boot_id: Path = BOOT_ID) -> ClockReading:
        """Both clocks, and the boot that the monotonic one counts from."""
        try:
            boot = boot_id.read_text().strip()
        except OSError:
            boot = ""
        return ClockReading(time.monotonic_ns(), time.time_ns(), boot)

    def is_of_the_boot_of(self, now: ClockReading) -> bool:
        """True if the monotonic clock has run on until ``now``; False where no boot is known."""
        known = self.boot != "" and self.boot == now.boot
        return known and now.monotonic_ns >= self.monotonic_ns

    def shift_ns(self, now: ClockReading) -> int:
        """What to add to ``now``'s monotonic clock so that the dive's clock continues from here.

        As before after a restart of the process. After one of the machine, what the wall clock says
        has passed; if that was set back meanwhile, a second.
        """
        if self.is_of_the_boot_of(now):
            return self.dive_shift_ns
        passed = max(now.wall_ns - self.wall_ns, LEAST_GAP_NS)
        return self.dive_ns + passed - now.monotonic_ns

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)
