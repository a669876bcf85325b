"""Whose MAVLink messages are used: the autopilot's, and those that the config names as well."""

from __future__ import annotations

import logging

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.events import about
from aquaflow.drivers.protocol.mavlink_frames import Header
from aquaflow.drivers.protocol.mavlink_samples import MavlinkSamples

log = logging.getLogger(__name__)

MOST_WARNINGS = 16
"""Senders and messages that a warning names; the others are counted only."""
OF_MANY = frozenset({"SYSTEM_TIME"})
"""Ground stations send it too; that is no loss."""


class MavlinkSenders:
    """The converters of each sender on one link."""

    def __init__(self, name: str, config: MavlinkConfig) -> None:
        asked = [str(message) for message in config.messages]
        asked += [] if config.external_pressure is None else [config.external_pressure]
        asked += [] if config.lights is None else [config.lights.message]
        self._name = name
        self.autopilot = (config.system_id, config.component_id)
        self._samples = {self.autopilot: MavlinkSamples(config, asked)}
        for other in config.also:
            sender = (other.system_id or config.system_id, other.component_id)
            self._samples[sender] = MavlinkSamples(config, other.messages)
        self._warned: set[tuple[int, int, str]] = set()

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the messages that make samples, whoever sends them."""
        return frozenset().union(*(each.wanted for each in self._samples.values()))

    @property
    def asked(self) -> dict[tuple[int, int], frozenset[str]]:
        """The same by system and component of the sender."""
        return {sender: each.wanted for sender, each in self._samples.items()}

    def of(self, header: Header, message: str) -> MavlinkSamples | None:
        """What converts ``message`` of this sender; None if it is not asked for it."""
        samples = self._samples.get((header.system, header.component))
        return samples if samples is not None and message in samples.wanted else None

    def unheard(self, header: Header, message: str) -> bool:
        """Whether a message that is used of others is lost; a warning names its sender once."""
        if message in OF_MANY or message not in self.wanted:
            return False
        if (header.system, header.component) in self._samples:
            return False
        sender = (header.system, header.component, message)
        if sender not in self._warned and len(self._warned) < MOST_WARNINGS:
            self._warned.add(sender)
            log.warning(
                "%s: %s of system %d, component %d is not used; to use it, add "
                "{system_id: %d, component_id: %d, messages: [%s]} under 'also'",
                self._name, message, *sender[:2], *sender, extra=about(self._name, "unheard"),
            )  # fmt: skip
        return True
