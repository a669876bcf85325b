"""Dives that begin and end with the vehicle's arming, and by its ground station's commands."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from typing import Literal

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import DiveConfig, VehicleReportConfig
from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.control import DivePhase, RefusedError, ServiceControl, ServiceRequest
from aquaflow.live.feed import Feed
from aquaflow.live.health.state import OF_STATE, Health, ServiceState
from aquaflow.live.service_status import ServiceStatus
from aquaflow.sources.outbound import HearsPilot, NamedValue, PilotRequest, StatusText

log = logging.getLogger(__name__)


def refuse_without_autopilot(vehicle: VehicleConfig) -> None:
    """A service that waits for an autopilot must have one that it can hear.

    Raises:
        ConfigError: no device speaks MAVLink, or, for commands, none that it may answer.
    """
    dive = vehicle.service.dive
    autopilots = [
        each for each in vehicle.telemetry.devices.values() if isinstance(each, MavlinkConfig)
    ]
    for key, asked, able in (
        ("begin: when_armed", dive.begin == "when_armed", bool(autopilots)),
        ("finish: when_disarmed", dive.finish == "when_disarmed", bool(autopilots)),
        ("commands: true", dive.commands, any(each.talk for each in autopilots)),
    ):
        if asked and not able:
            raise ConfigError(
                f"service.dive.{key} needs a device of kind mavlink in telemetry.devices"
                f"{' with talk: true' if autopilots else ''}; add one or leave the key out"
            )


class Arming:
    """A watcher of the service; construct it to have commands obeyed as well."""

    def __init__(self, config: DiveConfig, control: ServiceControl, pilot: HearsPilot) -> None:
        self._config, self._control, self._pilot = config, control, pilot
        self._armed = False
        """In the turn before."""
        self._begun = False
        """Since it was armed a dive was under way: it begins one, and no second."""
        self._disarmed_s: float | None = None
        """When it was disarmed, until it is armed again or its dive finished."""
        if config.commands:
            pilot.obey(self.obey)

    def obey(self, request: PilotRequest) -> bool:
        """Pass a command on; False where it makes no sense now. For any thread."""
        try:
            self._control.ask(ServiceRequest(request))
        except RefusedError as refused:
            log.warning("a command by MAVLink to %s: %s", request, refused)
            return False
        return True

    def update(self, service: ServiceStatus, now_s: float | None = None) -> None:
        """Called after every turn; asks for what arming and disarming mean."""
        now, armed = time.monotonic() if now_s is None else now_s, self._pilot.armed
        if armed is None:
            return
        if armed:
            self._disarmed_s = None
            self._begin()
        elif self._armed:
            self._begun, self._disarmed_s = False, now
        self._armed = armed
        if self._control.phase in (DivePhase.IDLE, DivePhase.FINISHING):
            self._disarmed_s = None  # a dive begun from here on is none of that arming's
        if self._disarmed_s is not None and now - self._disarmed_s >= self._config.disarmed_s:
            self._disarmed_s = None
            if self._config.finish == "when_disarmed":
                self._ask(ServiceRequest.FINISH)

    def _begin(self) -> None:
        if self._begun or self._control.phase is DivePhase.FINISHING:
            return  # which is waited for: the dive of this arming comes after it
        self._begun = True
        if self._config.begin == "when_armed" and self._control.phase is DivePhase.IDLE:
            self._ask(ServiceRequest.START)

    def _ask(self, request: ServiceRequest) -> None:
        with contextlib.suppress(RefusedError):  # the pilot was faster
            self._control.ask(request)


# --------------------------------------------------------------------------------------------------
# Messages to the pilot: a sentence when something changes, values once a second.

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
