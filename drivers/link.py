"""Byte links to devices: the protocols of transports and decoders, and the counters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

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
