"""Messages to the pilot: a sentence when something changes, values once a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Literal

from aquaflow.config.service import VehicleReportConfig
from aquaflow.live.feed import Feed
from aquaflow.live.health.sentences import OF_STATE
from aquaflow.live.health.state import Health, ServiceState
from aquaflow.live.service_status import ServiceStatus
from aquaflow.sources.outbound import NamedValue, StatusText

EVERY_S = 1.0
"""Period of the numbers that the autopilot logs."""
SPACING_S = 2.0
"""Least time between two sentences: ground stations speak each."""
REPEAT_S = 15.0
"""Least time until the same sentence comes again: a state that flaps must not fill the pilot's
screen."""

HINTED_IN = (ServiceState.TRACKING, ServiceState.DEGRADED)
"""States in which a pilot has time for what could be better."""

SEVERITY: dict[ServiceState, Literal["error", "warning", "notice", "info"]] = {
    ServiceState.WAITING: "error",
    ServiceState.LOST: "warning",
    ServiceState.DEGRADED: "warning",
    ServiceState.INCONSISTENT: "warning",
    ServiceState.TRACKING: "notice",
    ServiceState.PAUSED: "notice",
}
"""How urgent each state is to the pilot."""


class PilotMessages:
    """A watcher of the loop."""

    def __init__(
        self,
        config: VehicleReportConfig,
        feed: Feed,
        hints: Callable[[], Sequence[str]] = tuple,
    ) -> None:
        """``hints``: what the pilot could do better now, in sentences."""
        self._config, self._feed, self._hints = config, feed, hints
        self._standing: set[str] = set()
        """Sentences that were said and still hold."""
        self._said_s: dict[str, float] = {}
        """When each sentence of the last ``REPEAT_S`` was said."""
        self._told_s = -EVERY_S

    def update(self, loop: ServiceStatus, now_s: float | None = None) -> None:
        """Called after every turn of the loop; sends what is new or due."""
        now = time.monotonic() if now_s is None else now_s
        if self._config.status_text:
            self._say(loop.health, now)
        if self._config.values and now - self._told_s >= EVERY_S:
            self._told_s = now
            lag = loop.counters.lag_ms()["p95"] or 0.0
            for name, value in (
                ("AQ_STATE", float(loop.health.state.number)),
                ("AQ_LEVEL", float(loop.degradation.level)),
                ("AQ_LAG_MS", lag),
                ("AQ_FPS", loop.counters.fps),
            ):
                self._feed.send(NamedValue(time.monotonic_ns(), name, value))

    def _say(self, health: Health, now: float) -> None:
        """The first sentence that holds now and was not said since it began to."""
        hints = self._hints() if self._config.hints and health.state in HINTED_IN else ()
        own = health.sentences or (OF_STATE[health.state],)
        holding = (*own, *hints)
        self._standing &= set(holding)
        soon = now - max(self._said_s.values(), default=-SPACING_S) < SPACING_S
        if soon and health.state is not ServiceState.STOPPING:  # which has no later
            return
        self._said_s = {each: at for each, at in self._said_s.items() if now - at < REPEAT_S}
        for sentence in holding:
            if sentence not in self._standing and sentence not in self._said_s:
                self._standing.add(sentence)
                self._said_s[sentence] = now
                severity = SEVERITY.get(health.state, "info") if sentence in own else "notice"
                self._feed.send(StatusText(severity, sentence))
                return
