"""Dives that begin and end with the vehicle's arming, and by its ground station's commands."""

from __future__ import annotations

import contextlib
import logging
import time

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import DiveConfig
from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.control import DivePhase, RefusedError, ServiceControl, ServiceRequest
from aquaflow.live.service_status import ServiceStatus
from aquaflow.sources.outbound import HearsPilot, PilotRequest

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
