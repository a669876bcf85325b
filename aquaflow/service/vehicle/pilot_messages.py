"""Messages to the pilot: a sentence at each change of state, values once a second."""

from __future__ import annotations

import time
from typing import Literal

from aquaflow.config.service import VehicleReportConfig
from aquaflow.service.feed import Feed
from aquaflow.service.health.state import State
from aquaflow.service.loop import LiveLoop
from aquaflow.sources.outbound import NamedValue, StatusText

EVERY_S = 1.0
"""Period of the numbers that the autopilot logs."""
SPACING_S = 2.0
"""Between sentences: a state that flaps must not fill the pilot's screen."""

SEVERITY: dict[State, Literal["error", "warning", "notice", "info"]] = {
    State.WAITING: "error",
    State.LOST: "warning",
    State.DEGRADED: "warning",
    State.INCONSISTENT: "warning",
    State.TRACKING: "notice",
}
"""How urgent each state is to the pilot."""


class PilotMessages:
    """A watcher of the loop."""

    def __init__(self, config: VehicleReportConfig, feed: Feed) -> None:
        self._config, self._feed = config, feed
        self._said: State | None = None
        self._said_s = self._told_s = -SPACING_S

    def update(self, loop: LiveLoop, now_s: float | None = None) -> None:
        """Called after every turn of the loop; sends what is new or due."""
        now = time.monotonic() if now_s is None else now_s
        state = loop.health.state
        if self._config.status_text and state is not self._said and now - self._said_s >= SPACING_S:
            self._said, self._said_s = state, now
            severity = SEVERITY.get(state, "info")
            self._feed.send(StatusText(severity, f"AquaFlow {state.value}: {loop.health.reason}"))
        if self._config.values and now - self._told_s >= EVERY_S:
            self._told_s = now
            lag = loop.counters.lag_ms()["p95"] or 0.0
            for name, value in (
                ("AQ_STATE", float(state.number)),
                ("AQ_LEVEL", float(loop.degradation.level)),
                ("AQ_LAG_MS", lag),
                ("AQ_FPS", loop.counters.fps),
            ):
                self._feed.send(NamedValue(time.monotonic_ns(), name, value))
