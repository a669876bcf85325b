"""Frame indices and time of a run that resumes a dive: they continue those of the run before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from aquaflow.clocks.device import Learned
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.messages import Dropped, Frame, TelemetrySample
from aquaflow.service.moment import Moment


@dataclass(frozen=True)
class Continued:
    """Nothing to continue, unless made by :meth:`after`."""

    first_index: int = 0
    """Frames before this one were finished, or lost, in the run before."""
    shift_ns: int = 0
    """From this boot's clock to the dive's."""
    clocks: Mapping[str, Learned] = field(default_factory=dict)
    """Learned clock mappings, by device."""

    @staticmethod
    def after(
        moment: Moment,
        rows: Sequence[FrameRow],
        clocks: Mapping[str, Learned],
        now: Moment | None = None,
    ) -> Continued:
        """After the run that took a checkpoint at ``moment``, knew the devices' ``clocks`` then and
        left ``rows``. With another boot CLOCK_MONOTONIC is another one: clocks are learned anew."""
        first = 1 + max((row.index for row in rows), default=-1)
        now = now or Moment.now()
        known = clocks if moment.is_of_the_boot_of(now) else {}
        return Continued(first, moment.shift_ns(now), known)

    def shifted(self, sample: TelemetrySample) -> TelemetrySample:
        """A sample on the dive's clock."""
        if self.shift_ns == 0:
            return sample
        t_ns, arrival_ns = sample.t_ns + self.shift_ns, sample.arrival_ns + self.shift_ns
        return replace(sample, t_ns=t_ns, arrival_ns=arrival_ns)

    def counted(self, frame: Frame | Dropped) -> Frame | Dropped:
        """A frame of a device that began to count anew."""
        index, t_ns = frame.index + self.first_index, frame.t_ns + self.shift_ns
        if isinstance(frame, Dropped):
            return replace(frame, index=index, t_ns=t_ns)
        return replace(frame, index=index, t_ns=t_ns)
