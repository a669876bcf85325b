"""Device clocks on CLOCK_MONOTONIC, by minimum-latency filtering.

A message that the device stamped ``device_ns`` arrives at ``arrival_ns`` = clock(device_ns) +
latency, and latency is never negative. So the device's clock, offset plus drift, is the line that
lies under all points (device_ns, arrival_ns - device_ns) and as close to them as it can: the edge
of their lower convex hull over the middle of the window (Moon, Skelly, Towsley, INFOCOM 1999).
Jitter and spikes only lift points off that line. The latency that every message has cannot be seen
this way; round trips (MAVLink TIMESYNC) bound it from the other side.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

log = logging.getLogger(__name__)

BUCKET_NS = 1_000_000_000
"""Of each second of device time only the fastest message is kept."""

WINDOW_BUCKETS = 120
"""Two minutes: long enough that a 4 Hz DVL has fast messages in it, short enough that a crystal's
drift stays the same while it warms up."""

MIN_DRIFT_SPAN_NS = 20_000_000_000
"""Over less, 5 ms of jitter look like more drift than the 100 ppm that poor crystals have."""

MAX_DRIFT = 500e-6
"""Five times a poor crystal's; more is not drift."""

REORDERED_NS = 500_000_000
"""UDP brings messages late by less; a device clock that goes back further was started anew."""

STEP_NS = 100_000_000
"""A message this much faster than the fastest of the window shows a clock that was set forward."""

CONTRADICTIONS = 3
"""So many messages in a row make a new clock; a single one is a damaged time stamp."""

Learned = Sequence[Sequence[int | None]]
"""The buckets of a mapping, to be stored across a restart of the process."""


@dataclass(frozen=True)
class ClockReport:
    """State of a device's clock mapping."""

    offset_ns: int
    """CLOCK_MONOTONIC minus device clock, now."""
    drift_ppm: float
    """How much slower than CLOCK_MONOTONIC the device's clock runs."""
    uncertainty_ns: int
    """With round trips: bound of the error, as far as the clocks are steady. Without: how far the
    fastest messages scatter; the latency that all messages share comes on top, unseen."""
    round_trips: bool
    """True while a round trip of the window bounds the latency."""
    resets: int
    """Times that the device's clock began anew: reboot, wrap-around, or being set."""
    outliers: int
    """Messages whose time fits neither the clock nor a new one."""


@dataclass
class _Bucket:
    """The extremes of one second of device time."""

    number: int
    device_ns: int
    offset_ns: int
    """Smallest arrival - device: an upper bound of the clock's offset at ``device_ns``."""
    bound_device_ns: int | None = None
    bound_ns: int | None = None
    """Largest arrival - round trip - device: a lower bound at ``bound_device_ns``."""

    @staticmethod
    def of(row: Sequence[int | None]) -> _Bucket:
        """The bucket that was written as a row.

        Raises:
            TypeError, ValueError: it is none.
        """
        number, device_ns, offset_ns, *bound = row
        if number is None or device_ns is None or offset_ns is None or len(bound) != 2:
            raise ValueError(f"{row} is no second of a clock")
        bounded = [None if value is None else int(value) for value in bound]
        return _Bucket(int(number), int(device_ns), int(offset_ns), *bounded)


@dataclass(frozen=True)
class _Line:
    """Clock offset as a function of device time."""

    device_ns: int
    offset_ns: float
    drift: float
    uncertainty_ns: float
    round_trips: bool

    def at(self, device_ns: int) -> float:
        return self.offset_ns + self.drift * (device_ns - self.device_ns)


class ClockMapping:
    """Maps one device's clock to CLOCK_MONOTONIC; memory and work per message are bounded.

    While the mapping learns, mapped times may step back: by a spike's length in the first seconds,
    later by less than its uncertainty.
    """

    def __init__(self, name: str = "device", max_drift: float = MAX_DRIFT) -> None:
        """``max_drift``: the most by which its clock may run fast or slow, as a share."""
        self.name, self._max_drift = name, max_drift
        self.resets = 0
        self.outliers = 0
        self._buckets: deque[_Bucket] = deque(maxlen=WINDOW_BUCKETS)
        self._newest_ns = 0
        self._line: _Line | None = None
        self._contradictions: list[tuple[int, int, int | None]] = []
        self._earlier: list[_Bucket] = []

    def add(self, device_ns: int, arrival_ns: int, round_trip_ns: int | None = None) -> None:
        """Learn from a message.

        Args:
            device_ns: the device's stamp, on its own clock.
            arrival_ns: CLOCK_MONOTONIC when the message reached this process.
            round_trip_ns: where the message answers a request of ours: arrival minus request.
        """
        if self._earlier:
            self._take_up()
        if self._contradicts(device_ns, arrival_ns - device_ns):
            self._contradictions.append((device_ns, arrival_ns, round_trip_ns))
            if len(self._contradictions) == CONTRADICTIONS:
                self._begin_anew()
            return
        self.outliers += len(self._contradictions)
        self._contradictions.clear()
        self._learn(device_ns, arrival_ns, round_trip_ns)

    def learned_mapping(self) -> Learned:
        """What :meth:`resume` takes; may be called from another thread than ``add`` is."""
        return [astuple(bucket) for bucket in tuple(self._buckets)]

    def resume(self, earlier: Learned) -> None:
        """Continue from what an earlier process learned since the same boot; likewise. If the
        device's clock restarted meanwhile, its messages will show it. Malformed rows are
        ignored."""
        try:
            self._earlier = [_Bucket.of(row) for row in earlier]
        except (TypeError, ValueError) as error:
            log.warning(
                "the clock of %s is learned anew: %s", self.name, error, extra=self._fields()
            )

    def to_monotonic(self, device_ns: int) -> int | None:
        """CLOCK_MONOTONIC of a moment on the device's clock; None before the first message."""
        if self._line is None:
            return None
        return device_ns + round(self._line.at(device_ns))

    def report(self) -> ClockReport | None:
        """Offset, drift and uncertainty; None before the first message."""
        line = self._line
        if line is None:
            return None
        return ClockReport(
            offset_ns=round(line.at(self._newest_ns)),
            drift_ppm=line.drift * 1e6,
            uncertainty_ns=round(line.uncertainty_ns),
            round_trips=line.round_trips,
            resets=self.resets,
            outliers=self.outliers,
        )

    def _take_up(self) -> None:
        """The earlier process's messages, and then those that came before we knew of them."""
        earlier, self._earlier = self._earlier, []
        since = tuple(self._buckets)
        self._buckets = deque(earlier, maxlen=WINDOW_BUCKETS)
        self._newest_ns = self._buckets[-1].device_ns
        self._line = _fit(self._buckets, self._max_drift)
        for bucket in since:
            self.add(bucket.device_ns, bucket.device_ns + bucket.offset_ns)

    def _contradicts(self, device_ns: int, offset_ns: int) -> bool:
        """True if no latency explains the message: its clock is another one, or damaged."""
        if self._line is None:
            return False
        if device_ns < self._newest_ns - REORDERED_NS:
            return True
        learned = self._newest_ns - self._buckets[0].device_ns >= MIN_DRIFT_SPAN_NS
        step = STEP_NS if learned else 10 * STEP_NS
        return offset_ns < self._line.at(device_ns) - step

    def _begin_anew(self) -> None:
        """Forget the old clock and learn the new one from the messages that revealed it."""
        self.resets += 1
        log.warning(
            "the clock of %s began anew (%d times so far)", self.name, self.resets,
            extra=self._fields(),
        )  # fmt: skip
        revealed, self._contradictions = self._contradictions, []
        self._buckets.clear()
        self._line = None
        for device_ns, arrival_ns, round_trip_ns in revealed:
            self.add(device_ns, arrival_ns, round_trip_ns)

    def _fields(self) -> dict[str, dict[str, str]]:
        """Of a log record."""
        return {"fields": {"event": "clock", "source": self.name}}

    def _learn(self, device_ns: int, arrival_ns: int, round_trip_ns: int | None) -> None:
        first = self._line is None
        self._newest_ns = device_ns if first else max(self._newest_ns, device_ns)
        offset_ns = arrival_ns - device_ns
        number = device_ns // BUCKET_NS
        changed = True
        if not self._buckets or number > self._buckets[-1].number:
            self._buckets.append(_Bucket(number, device_ns, offset_ns))
        else:
            changed = self._improve(self._buckets[-1], device_ns, offset_ns)
        if round_trip_ns is not None and round_trip_ns >= 0:
            changed |= self._bound(self._buckets[-1], device_ns, offset_ns - round_trip_ns)
        if changed:
            self._line = _fit(self._buckets, self._max_drift)

    @staticmethod
    def _improve(bucket: _Bucket, device_ns: int, offset_ns: int) -> bool:
        if offset_ns >= bucket.offset_ns:
            return False
        bucket.device_ns, bucket.offset_ns = device_ns, offset_ns
        return True

    @staticmethod
    def _bound(bucket: _Bucket, device_ns: int, bound_ns: int) -> bool:
        if bucket.bound_ns is not None and bound_ns <= bucket.bound_ns:
            return False
        bucket.bound_device_ns, bucket.bound_ns = device_ns, bound_ns
        return True


def _fit(buckets: deque[_Bucket], max_drift: float) -> _Line:
    """The line under the fastest messages, lowered by half of what round trips leave open."""
    origin = buckets[0]
    x = np.array([bucket.device_ns - origin.device_ns for bucket in buckets], np.float64)
    y = np.array([bucket.offset_ns - origin.offset_ns for bucket in buckets], np.float64)
    drift = 0.0
    if x[-1] - x[0] >= MIN_DRIFT_SPAN_NS:
        drift = float(np.clip(_slope_under(x, y), -max_drift, max_drift))
    gaps = y - drift * x
    base = float(gaps.min())
    lowest = [
        drift * (bucket.bound_device_ns - origin.device_ns) + base + origin.offset_ns
        - bucket.bound_ns
        for bucket in buckets
        if bucket.bound_ns is not None and bucket.bound_device_ns is not None
    ]  # fmt: skip
    # Steady clocks leave every gap between the bounds positive.
    half = max(min(lowest), 0.0) / 2.0 if lowest else 0.0
    scatter = float(np.median(gaps - base))
    return _Line(
        origin.device_ns,
        origin.offset_ns + base - half,
        drift,
        half if lowest else scatter,
        bool(lowest),
    )


def _slope_under(
    x: npt.NDArray[np.float64],  # [N], not decreasing
    y: npt.NDArray[np.float64],  # [N]
) -> float:
    """Slope of the edge of the lower convex hull over the mean of ``x``."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1 and _turns_down(x, y, hull[-2], hull[-1], k):
            hull.pop()
        hull.append(k)
    middle = float(x.mean())
    for left, right in pairwise(hull):
        if x[right] >= middle and x[right] > x[left]:
            return float((y[right] - y[left]) / (x[right] - x[left]))
    return 0.0


def _turns_down(
    x: npt.NDArray[np.float64],  # [N]
    y: npt.NDArray[np.float64],  # [N]
    a: int,
    b: int,
    c: int,
) -> bool:
    """True if point b does not lie under the line from a to c."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
