"""Moments of measurement from a device's own stamps, never later or much earlier than arrival."""

from __future__ import annotations

from aquaflow.base.clocks.device import ClockMapping

MAX_AGE_NS = 2_000_000_000
"""No link delays a message longer; an older stamp means that a clock was set."""


class DeviceClock:
    """One device's clock on CLOCK_MONOTONIC."""

    def __init__(self, name: str) -> None:
        self.mapping = ClockMapping(name)

    def stamp(self, device_ns: int, arrival_ns: int) -> int:
        """When something stamped ``device_ns`` was measured; learns from the message as well."""
        self.mapping.add(device_ns, arrival_ns)
        return self.moment(device_ns, arrival_ns)

    def moment(self, device_ns: int, arrival_ns: int) -> int:
        """The same of a stamp that may be old when it is sent, and so says nothing of the clock."""
        t_ns = self.mapping.to_monotonic(device_ns)
        if t_ns is None or not arrival_ns - MAX_AGE_NS <= t_ns <= arrival_ns:
            return arrival_ns
        return t_ns
