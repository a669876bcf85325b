"""Byte links to devices: protocols of transports and decoders, counters, events, device clocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

from aquaflow.base.clocks.device import ClockMapping
from aquaflow.types import TelemetrySample

MAX_READ_BYTES = 65_536
"""Most that one read returns: the largest UDP datagram."""


class LinkLostError(Exception):
    """The device or its peer is gone; opening the link again may succeed."""


@dataclass
class LinkCounters:
    """What happened on a link since it was first opened."""

    bytes: int = 0
    messages: int = 0
    """Packets or sentences with a good checksum."""
    samples: int = 0
    """Telemetry samples handed over."""
    bad_checksums: int = 0
    garbage_bytes: int = 0
    """Bytes that belong to no packet, skipped to find the next one."""
    invalid_values: int = 0
    """Good packets whose values are impossible, or that the device itself calls invalid."""
    unheard: int = 0
    """Good packets of senders that the config does not name, which would have made samples."""
    dropped_samples: int = 0
    """Oldest samples dropped because they were not fetched in time."""
    reconnects: int = 0


class ByteLink(Protocol):
    """An open serial port, socket or pty."""

    name: str
    """For logs and the recorder, stable over reconnects."""

    def read(self, timeout_s: float) -> bytes:
        """The bytes that have arrived, at most MAX_READ_BYTES; empty when ``timeout_s`` passed
        without any.

        Raises:
            LinkLostError: the device or the peer is gone.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send ``data`` whole; raises LinkLostError as ``read`` does."""
        ...

    def close(self) -> None:
        """Close; may be called again."""
        ...


class LinkDecoder(Protocol):
    """Turns the bytes of one link into samples; resynchronises by itself, its buffer is bounded."""

    counters: LinkCounters

    def feed(self, data: bytes, arrival_ns: int) -> list[TelemetrySample]:
        """Samples that ``data`` completes. Never raises for what the bytes hold."""
        ...


# --------------------------------------------------------------------------------------------------
# What happens to devices, as fields of log records: keys of log.jsonl (docs/formats.md#log).

Event: TypeAlias = Literal[
    "waiting",
    "connected",
    "format",
    "lost",
    "reconnected",
    "late",
    "failed",
    "unheard",
    "unused",
    "refused",
]
"""``waiting``: not there, and looked for; ``late``: its pictures show the past; ``unheard``:
another sender's message; ``unused``: what the settings, the device's or ours, make useless;
``refused``: what the device was asked for."""


def about(source: str, event: Event) -> dict[str, dict[str, str]]:
    """``extra`` of a log record about the device ``source``."""
    return {"fields": {"event": event, "source": source}}


# --------------------------------------------------------------------------------------------------
# Moments of measurement from a device's own stamps, never later or much earlier than arrival.

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
