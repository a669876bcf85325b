"""How long the end of a dive may take, and until when each of its phases may go on.

A supervisor that waits for a stopped service kills it after a while. Everything that can be cut
short is therefore cut at a moment; what one phase leaves of its time goes to those after it.
"""

from __future__ import annotations

import time

from aquaflow.base.clocks.deadline import Deadline, Now

SETTLED, REFINED, EVALUATED = 0.25, 0.55, 0.80
"""Shares of the whole after which a phase ends (docs/measurements.md#finishing)."""


class FinishTime:
    """The phases in their order."""

    def __init__(self, seconds: float | None = None, now_s: Now = time.monotonic) -> None:
        """The next ``seconds``; None: as many as it takes."""

        def until(share: float) -> Deadline:
            return Deadline(None if seconds is None else share * seconds, now_s)

        self.settling = until(SETTLED)
        """Poses of frames that wait, the map's backlog, the last optimisations of the graph."""
        self.refining = until(REFINED)
        """The map."""
        self.evaluating = until(EVALUATED)
        """Held-out views: what is not evaluated by then is not in the report."""
        self.whole = until(1.0)
        """Everything; files that are not optional are written whatever it says."""
