"""UTC of the dive's clock: one line for the whole dive, whatever its sources did meanwhile.

Trusted in this order: a GNSS receiver, the autopilot (which has heard the time from a receiver or
a ground station), any other clock, such as the computer's own. Of sources of one kind the one with
most samples counts. A source that was set during the dive counts with the last setting that it
kept: clocks are set because they were wrong, a computer's when the network comes up, a receiver's
when it learns of the leap seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from enum import IntEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from aquaflow.base.clocks.wall import JUMP_NS
from aquaflow.optimise.least_squares import RobustFit, Rules, covariance_of, minimise
from aquaflow.optimise.robust import Huber
from aquaflow.types import UtcTime

Array = npt.NDArray[np.float64]

GNSS_MESSAGES = frozenset({"RMC", "ZDA", "GPS_RAW_INT", "GPS2_RAW", "GPS", "126992"})
"""NMEA 0183, MAVLink, dataflash and NMEA 2000 messages that a receiver fills."""
AUTOPILOT_MESSAGES = frozenset({"SYSTEM_TIME"})
"""MAVLink's message of the autopilot's own clock."""


class Trust(IntEnum):
    """What kind of clock a source is; the least number is trusted most."""

    GNSS = 0
    AUTOPILOT = 1
    OTHER = 2

    @staticmethod
    def of(source: str) -> Trust:
        """Trust by the message that the source's name ends in, as drivers name them."""
        message = source.rpartition("/")[2]
        if message in GNSS_MESSAGES:
            return Trust.GNSS
        return Trust.AUTOPILOT if message in AUTOPILOT_MESSAGES else Trust.OTHER


SYSTEMATIC_SIGMA_S = {Trust.GNSS: 0.2, Trust.AUTOPILOT: 0.3, Trust.OTHER: 1.0}
"""1 sigma, s, that averaging leaves. A receiver's sentence comes 0.05 to 0.5 s after the moment it
states; an autopilot adds its link; a computer may have had no network since yesterday (a crystal of
10 ppm loses 0.9 s a day)."""
DRIFT_SIGMA = 5e-5
"""1 sigma of the dive clock's rate before anything is known: crystals are sold at 20 to 50 ppm."""
LEAST_SIGMA_S = 1e-3
"""Of one sample: no source states its time to better."""
LASTING_SAMPLES = 3
"""Samples that make a setting."""
LASTING_SHARE = 0.05
"""Of a source's samples: a setting kept for less is a damaged message, or one that came late."""
RULES = Rules(iterations=20, sigmas=1e-3, damping=0.0)
"""Of the reweighted fit; 4 iterations are enough where one sample in ten is late."""


@dataclass(frozen=True)
class UtcClock:
    """UTC as a straight line over the dive's clock."""

    middle_ns: int
    """Moment of the dive's clock for which ``offset_ns`` is stated."""
    offset_ns: int
    """UTC since 1970 minus the dive's clock."""
    drift: float
    """How much faster UTC runs than the dive's clock."""
    sigma_s: float
    """1 sigma of ``offset_ns``."""
    drift_sigma: float
    source: str
    notes: tuple[str, ...] = ()
    """Sentences for the user about clocks that were set, or that disagree."""

    def utc_ns(self, t_ns: int) -> int:
        """UTC of a moment of the dive's clock, ns since 1970."""
        return t_ns + self.offset_ns + round(self.drift * (t_ns - self.middle_ns))

    def utc_of(self, t_ns: int) -> datetime:
        """UTC of a moment of the dive's clock, to the microsecond below."""
        return datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(
            microseconds=self.utc_ns(t_ns) // 1000
        )

    def sigma_at_s(self, t_ns: int) -> float:
        """1 sigma of the UTC of a moment: it grows with the distance from what was heard."""
        return float(np.hypot(self.sigma_s, self.drift_sigma * 1e-9 * (t_ns - self.middle_ns)))


def utc_of(clock: UtcClock | None, t_ns: int) -> datetime | None:
    """UTC of a moment of the dive's clock; None where no source stated it."""
    return None if clock is None else clock.utc_of(t_ns)


def fit_utc(samples: Iterable[UtcTime]) -> UtcClock | None:
    """The line of the most trusted source; None if no source stated the time consistently."""
    by_source: dict[str, list[UtcTime]] = {}
    for sample in samples:
        by_source.setdefault(sample.source, []).append(sample)
    notes, kept = [], []
    for source, stated in sorted(by_source.items()):
        settings = _settings(sorted(stated, key=lambda sample: sample.t_ns))
        if settings:
            kept.append((source, settings[-1]))
        notes += [
            f"{source} was set by {_step_s(before, after):+.1f} s during the dive"
            for before, after in pairwise(settings)
        ]
    if not kept:
        return None
    source, best = min(kept, key=lambda each: (Trust.of(each[0]), -len(each[1])))
    clock = _line(source, best)
    for other, setting in kept:
        away_s = _away_s(clock, setting)
        if abs(away_s) * 1e9 > JUMP_NS:
            notes.append(f"{other} is {away_s:+.1f} s away from the UTC of {source}, which is used")
    return UtcClock(**{**vars(clock), "notes": tuple(notes)})


def _settings(stated: Sequence[UtcTime]) -> list[list[UtcTime]]:
    """The samples of every setting of one clock that lasted, in the order of their ends.

    A sample belongs to the setting whose latest offset is near its own, so a single wrong one
    interrupts nothing, and a drift moves a setting along.
    """
    found: list[list[UtcTime]] = []
    for sample in stated:
        near = [each for each in found if abs(_offset_ns(each[-1]) - _offset_ns(sample)) < JUMP_NS]
        if near:
            near[-1].append(sample)
        else:
            found.append([sample])
    least = max(LASTING_SAMPLES, LASTING_SHARE * len(stated))
    lasting = [each for each in found if len(each) >= least]
    return sorted(lasting, key=lambda each: each[-1].t_ns)


def _offset_ns(sample: UtcTime) -> int:
    return sample.utc_ns - sample.t_ns


def _step_s(before: Sequence[UtcTime], after: Sequence[UtcTime]) -> float:
    return (_offset_ns(after[0]) - _offset_ns(before[-1])) * 1e-9


def _away_s(clock: UtcClock, setting: Sequence[UtcTime]) -> float:
    """Median of how far a source's samples are from ``clock``."""
    return float(np.median([(each.utc_ns - clock.utc_ns(each.t_ns)) * 1e-9 for each in setting]))


def _line(source: str, stated: Sequence[UtcTime]) -> UtcClock:
    """Robust line through the offsets; the prior keeps the drift of a short series near zero."""
    base_ns, first_ns = _offset_ns(stated[0]), stated[0].t_ns
    offset = np.array([(_offset_ns(each) - base_ns) * 1e-9 for each in stated])
    t = np.array([(each.t_ns - first_ns) * 1e-9 for each in stated])
    J = np.column_stack([np.ones(len(t)), t - t.mean()])
    problem = RobustFit(
        residuals=lambda x: J @ x - offset,
        jacobian=lambda x: J,
        kernel=Huber(),
        expected=np.zeros(2),
        sigma=np.array([np.inf, DRIFT_SIGMA]),
        least_noise=LEAST_SIGMA_S,
    )
    x = minimise(problem, np.array([np.median(offset), 0.0]), RULES).state
    spread = covariance_of(problem.linearise(x).H)
    return UtcClock(
        middle_ns=first_ns + round(1e9 * float(t.mean())),
        offset_ns=base_ns + round(1e9 * float(x[0])),
        drift=float(x[1]),
        sigma_s=float(np.hypot(np.sqrt(spread[0, 0]), SYSTEMATIC_SIGMA_S[Trust.of(source)])),
        drift_sigma=float(np.sqrt(spread[1, 1])),
        source=source,
        notes=(),
    )
