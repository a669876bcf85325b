"""The dive's clock: it counts from the first frame, also in a run that resumes the dive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from aquaflow.base.clocks.device import Learned
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.live.clock_reading import ClockReading
from aquaflow.types import Dropped, Frame


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
