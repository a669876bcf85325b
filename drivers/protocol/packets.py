"""Finding packets and printable lines in a stream of bytes, whatever else is in it.

Where a checksum fails, the search goes on one byte behind the packet's start and not behind its
end: the length may be what was damaged, and good packets would be skipped with it.
"""

from __future__ import annotations

import logging
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable

from aquaflow.drivers.link import DeviceClock, LinkCounters
from aquaflow.drivers.samples import plausible
from aquaflow.types import TelemetrySample

log = logging.getLogger(__name__)

NO_PACKET = 0
"""Length returned where no packet starts."""
INCOMPLETE = -1
"""Length of a packet whose header has not arrived completely."""


class Framing(ABC):
    """How a protocol's packets are delimited and checked."""

    longest: int
    """Bytes; what is kept while a packet is incomplete stays below."""
    padding = b""
    """Bytes that may stand between packets and are no garbage."""

    @abstractmethod
    def find(self, buffer: bytes, at: int) -> int:
        """Where, from ``at`` on, a packet may start; -1: nowhere."""

    @abstractmethod
    def length(self, buffer: bytes, at: int) -> int:
        """Bytes of the packet that starts at ``at``, at most ``longest``; NO_PACKET; INCOMPLETE."""

    @abstractmethod
    def intact(self, packet: bytes) -> bool:
        """True if the checksum is right."""


class PacketReader:
    """Cuts the packets with good checksums out of a stream, and counts the rest."""

    def __init__(self, framing: Framing, counters: LinkCounters) -> None:
        self.framing = framing
        self.counters = counters
        self._rest = b""
        self._damaged_until = 0
        """End of a packet whose checksum failed: what else fails in it is part of it."""

    def feed(self, data: bytes) -> list[bytes]:
        """Packets that ``data`` completes."""
        self.counters.bytes += len(data)
        buffer = self._rest + data
        packets: list[bytes] = []
        at = 0
        while at < len(buffer):
            start = self.framing.find(buffer, at)
            start = len(buffer) if start < 0 else start
            skipped = buffer[at:start].translate(None, self.framing.padding)
            self.counters.garbage_bytes += len(skipped)
            at = start
            if at == len(buffer):
                break
            length = self.framing.length(buffer, at)
            if length == INCOMPLETE or at + length > len(buffer):
                break
            at += self._take(buffer, at, length, packets)
        self._rest = buffer[at:]
        self._damaged_until = max(self._damaged_until - at, 0)
        return packets

    @property
    def pending(self) -> int:
        """Bytes kept for a packet that is not complete yet."""
        return len(self._rest)

    def reset(self) -> None:
        """Forget the half packet of a link that was lost: its other half will not come."""
        self.counters.garbage_bytes += len(self._rest)
        self._rest = b""
        self._damaged_until = 0

    def _take(self, buffer: bytes, at: int, length: int, packets: list[bytes]) -> int:
        """How far to advance: behind a good packet, or one byte."""
        if length != NO_PACKET:
            packet = buffer[at : at + length]
            if self.framing.intact(packet):
                packets.append(packet)
                self.counters.messages += 1
                self._damaged_until = 0
                return length
            if at >= self._damaged_until:
                self.counters.bad_checksums += 1
                self._damaged_until = at + length
        self.counters.garbage_bytes += 1
        return 1


class PacketDecoder(ABC):
    """A decoder of :mod:`aquaflow.drivers.link` with a framing; a subclass decodes the packets."""

    def __init__(self, name: str, framing: Framing) -> None:
        self.name = name
        self.counters = LinkCounters()
        self.reader = PacketReader(framing, self.counters)
        self.clock: DeviceClock | None = None
        """Clock of a device that stamps its messages with its own clock."""

    @abstractmethod
    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        """Samples of one good packet.

        Raises:
            ValueError: the values are impossible, or the device calls them invalid.
            ArithmeticError, LookupError, TypeError, struct.error: the packet does not hold what it
                should.
        """

    def feed(self, data: bytes, arrival_ns: int) -> list[TelemetrySample]:
        samples: list[TelemetrySample] = []
        for packet in self.reader.feed(data):
            try:
                decoded = self.decode(packet, arrival_ns)
            except (ValueError, ArithmeticError, LookupError, TypeError, struct.error) as error:
                log.debug("%s: packet without meaning: %s", self.name, error)
                self.counters.invalid_values += 1
                continue
            good = [sample for sample in decoded if plausible(sample)]
            self.counters.invalid_values += len(decoded) - len(good)
            samples += good
        self.counters.samples += len(samples)
        return samples

    def recognises(self, data: bytes) -> bool:
        """Whether a good packet of this protocol is in ``data``; nothing is decoded or counted."""
        return bool(PacketReader(self.reader.framing, LinkCounters()).feed(data))

    def reset(self) -> None:
        """The link was opened anew."""
        self.reader.reset()

    def source(self, what: str) -> str:
        """The samples' source name: device and message."""
        return f"{self.name}/{what}"


# --------------------------------------------------------------------------------------------------
# Protocols of printable lines: a mark at the start, a line end, a checksum in hexadecimal.


class LineFraming(Framing):
    """Lines that start with one of ``marks``."""

    padding = b"\r\n"

    def __init__(self, marks: bytes, longest: int, intact: Callable[[bytes], bool]) -> None:
        self.longest = longest
        self._marks = re.compile(b"[" + re.escape(marks) + b"]")
        self._intact = intact

    def find(self, buffer: bytes, at: int) -> int:
        found = self._marks.search(buffer, at)
        return found.start() if found else -1

    def length(self, buffer: bytes, at: int) -> int:
        # Two plain searches are twenty times faster than one of a set, which a flood would feel.
        ends = [buffer.find(end, at + 1, at + self.longest) for end in (b"\r", b"\n")]
        if max(ends) > 0:
            return min(end for end in ends if end > 0) + 1 - at
        return NO_PACKET if len(buffer) - at >= self.longest else INCOMPLETE

    def intact(self, packet: bytes) -> bool:
        return self._intact(packet)
