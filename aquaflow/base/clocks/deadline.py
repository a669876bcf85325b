"""Moments after which optional work is left out, on a clock that is never set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

Now = Callable[[], float]
"""Seconds on a clock that is never set."""


class Deadline:
    """Work may go on until ``seconds`` have passed; None: for ever."""

    def __init__(
        self,
        seconds: float | None = None,
        now_s: Now = time.monotonic,
        cut_s: Now = lambda: math.inf,
    ) -> None:
        """``cut_s``: the moment at which it ends at the latest, which may come nearer later."""
        self._now_s, self._cut_s, self._seconds = now_s, cut_s, seconds
        self._asked_s = math.inf if seconds is None else now_s() + seconds

    @property
    def _end_s(self) -> float:
        return min(self._asked_s, self._cut_s())

    @property
    def left_s(self) -> float:
        """Seconds that are left; 0 once it is over."""
        return max(self._end_s - self._now_s(), 0.0)

    @property
    def over(self) -> bool:
        """True once no time is left."""
        return self._now_s() >= self._end_s

    @property
    def passed(self) -> float:
        """The share of the time that has passed, 1 once it is over; 0 where it has no end."""
        if not self._seconds:
            return 0.0 if self._seconds is None else 1.0
        return min(max(1.0 - (self._end_s - self._now_s()) / self._seconds, 0.0), 1.0)

    @property
    def limited(self) -> bool:
        """False if there is time for ever."""
        return math.isfinite(self._end_s)

    def within(self, most_s: float | None) -> Deadline:
        """The earlier of this one and ``most_s`` from now; None: this one."""
        limits = [] if most_s is None else [most_s]
        limits += [self.left_s] if self.limited else []
        return Deadline(min(limits, default=None), self._now_s, self._cut_s)

    def share(self, part: float) -> Deadline:
        """One after ``part`` of the time that is left."""
        return self.within(part * self.left_s if self.limited else None)


# --------------------------------------------------------------------------------------------------
# How long the end of a dive may take, and until when each of its phases may go on.
#
# A supervisor that waits for a stopped service kills it after a while, so that the end of a dive is
# shorter from the moment on at which the service is told to stop. Everything that can be cut
# short is therefore cut at a moment; what one phase leaves of its time goes to those after it.

SETTLED, REFINED, EVALUATED = 0.25, 0.55, 0.80
"""Shares of the whole after which a phase ends (notes/2026-11-speed.md#finishing)."""


class FinishTime:
    """The phases in their order."""

    def __init__(
        self,
        seconds: float | None = None,
        now_s: Now = time.monotonic,
        stopped: Callable[[], bool] = lambda: False,
        stop_s: float = math.inf,
    ) -> None:
        """The next ``seconds``, or as many as it takes (None); once it is ``stopped``, no more than
        ``stop_s`` from there."""
        self._now_s, self._stopped, self._stop_s = now_s, stopped, stop_s
        self._stopped_at_s = math.inf

        def until(share: float) -> Deadline:
            return Deadline(
                None if seconds is None else share * seconds, now_s, lambda: self._cut_s(share)
            )

        self.settling = until(SETTLED)
        """Poses of frames that wait, the map's backlog, the last optimisations of the graph."""
        self.refining = until(REFINED)
        """The map."""
        self.evaluating = until(EVALUATED)
        """Held-out views: what is not evaluated by then is not in the report."""
        self.whole = until(1.0)
        """Everything; files that are not optional are written whatever it says."""

    def _cut_s(self, share: float) -> float:
        """When a phase ends because it was stopped; never, before that."""
        if math.isinf(self._stopped_at_s) and self._stopped():
            self._stopped_at_s = self._now_s()
        return self._stopped_at_s + share * self._stop_s
