"""How long the end of a dive may take, and until when each of its phases may go on.

A supervisor that waits for a stopped service kills it after a while, so that the end of a dive is
shorter from the moment on at which the service is told to stop. Everything that can be cut
short is therefore cut at a moment; what one phase leaves of its time goes to those after it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from aquaflow.base.clocks.wall import Deadline, Now

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
