"""The dive's clock across a restart: CLOCK_MONOTONIC restarts with every boot; and UTC by it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from aquaflow.base.clocks.device import Learned
from aquaflow.base.clocks.wall import WallClockWatch
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.types import Dropped, Frame, UtcTime

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
        """The reading on the dive's clock."""
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
        """The reading as plain values."""
        return asdict(self)


# --------------------------------------------------------------------------------------------------
# The dive's clock: it counts from the first frame, also in a run that resumes the dive.


@dataclass(frozen=True)
class Continued:
    """A new dive, unless made by :meth:`after`."""

    first_index: int = 0
    """Frames before this one were finished, or lost, in the run before."""
    shift_ns: int | None = None
    """From this boot's clock to the dive's; None until the first frame of a new dive."""
    clocks: Mapping[str, Learned] = field(default_factory=dict)
    """Learned clock mappings, by device."""

    @staticmethod
    def after(
        moment: ClockReading,
        rows: Sequence[FrameRow],
        clocks: Mapping[str, Learned],
        now: ClockReading | None = None,
    ) -> Continued:
        """After the run that took a checkpoint at ``moment``, knew the devices' ``clocks`` then and
        left ``rows``. With another boot CLOCK_MONOTONIC is another one: clocks are learned anew."""
        first = 1 + max((row.index for row in rows), default=-1)
        now = now or ClockReading.now()
        known = clocks if moment.is_of_the_boot_of(now) else {}
        return Continued(first, moment.shift_ns(now), known)

    @property
    def known_shift_ns(self) -> int:
        """The shift, or 0 where the devices' clock is still the dive's."""
        return self.shift_ns or 0

    def dive_s(self, now_ns: int) -> float | None:
        """Seconds since the first frame of a moment on this boot's clock; None before it."""
        return None if self.shift_ns is None else (now_ns + self.shift_ns) * 1e-9

    def begin(self, t_ns: int) -> Continued:
        """A dive that was not begun counts from ``t_ns``, its first frame."""
        return self if self.shift_ns is not None else replace(self, shift_ns=-t_ns)

    def count(self, frame: Frame | Dropped) -> Frame | Dropped:
        """A frame of a device that began to count anew."""
        index, t_ns = frame.index + self.first_index, frame.t_ns + self.known_shift_ns
        if isinstance(frame, Dropped):
            return replace(frame, index=index, t_ns=t_ns)
        return replace(frame, index=index, t_ns=t_ns)


# --------------------------------------------------------------------------------------------------
# The wall clock as a source of UTC, so that a recording holds what a live dive heard.

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
