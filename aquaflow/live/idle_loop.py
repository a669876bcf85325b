"""Turns of the service while no dive is mapped: the cameras stay open, nothing is kept."""

from __future__ import annotations

import time
from collections.abc import Callable

from aquaflow.base.stages import Profiler
from aquaflow.live.control import ServiceControl
from aquaflow.live.feed import Feed
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.state import ServiceState
from aquaflow.live.service_status import Counters, ServiceStatus
from aquaflow.types import Frame

STAGE = "standby"
"""Its name among the heartbeats."""
TURN_S = 0.5
"""Between turns: so often a picture is decoded, and so late at most a request is obeyed."""
IDLE = "no dive: it begins when the pilot asks for it"
"""The reason of the state IDLE."""
FINISHING = "the map is refined and the report written"
"""The reason of the state FINISHING."""


class IdleLoop:
    """To be used from the service's own thread."""

    def __init__(self, feed: Feed, control: ServiceControl, vitals: ServiceHealth) -> None:
        self.watchers: list[Callable[[ServiceStatus], None]] = []
        """Called after every turn; must not wait."""
        self.vitals = vitals
        self.health, self.degradation = vitals.health, vitals.degradation
        self.counters = Counters(Profiler())
        self.picture: Frame | None = None
        """The newest frame; no dive counted it."""
        self._feed, self._control = feed, control

    def turn(self, state: ServiceState, reason: str) -> None:
        """Wait a little for a picture, say how the service is, and wait for the next turn."""
        began_s = time.monotonic()
        self._take()
        self.vitals.heartbeats.beat(STAGE)
        self.health.set(state, reason)
        for watch in self.watchers:
            name = getattr(watch, "__qualname__", type(watch).__name__)
            with self._feed.failures.contain(f"service: {name}"):
                watch(self)
        self.vitals.notify()
        self._control.wait(TURN_S - (time.monotonic() - began_s))

    def end(self) -> None:
        """A dive begins, or the service ends."""
        self.vitals.heartbeats.retire(STAGE)
        self.picture = None

    def _take(self) -> None:
        self._feed.latest_samples.forget()
        frame = self._feed.newest.take(TURN_S)
        if isinstance(frame, Frame):
            self.picture = frame
