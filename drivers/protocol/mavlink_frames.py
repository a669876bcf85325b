"""MAVLink 1 and 2 on the wire (mavlink.io/en/guide/serialization.html).

The framing is our own: pymavlink's parser trusts a damaged length and swallows the packets behind
it. Message definitions, checksum seeds and unpackers are pymavlink's.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing

MARK_2 = 0xFD
MARKS = re.compile(b"[\xfd\xfe]")
"""First bytes of a packet: 0xFD of MAVLink 2, 0xFE of MAVLink 1."""
HEADER_1, HEADER_2 = 6, 10
"""Bytes before the payload of MAVLink 1 and 2, first byte included."""
CHECKSUM = 2
"""Bytes after the payload."""
SIGNED = 0x01
"""Incompatibility flag of a packet that a signature follows."""
SIGNATURE = 13
"""Bytes of a signature: link, time and hash."""


class Header(NamedTuple):
    """Who sent what."""

    message_id: int
    system: int
    component: int
    payload_end: int
    """Bytes from the packet's start."""


class MavlinkFraming(Framing):
    """Packets of messages that the dialect knows: without its seed no checksum can be tested."""

    longest = HEADER_2 + 255 + CHECKSUM + SIGNATURE

    def __init__(self, dialect: Any) -> None:
        self._crc = dialect.x25crc
        self._seeds: dict[int, int] = {
            number: message.crc_extra for number, message in dialect.mavlink_map.items()
        }

    def find(self, buffer: bytes, at: int) -> int:
        found = MARKS.search(buffer, at)
        return found.start() if found else -1

    def length(self, buffer: bytes, at: int) -> int:
        header = HEADER_2 if buffer[at] == MARK_2 else HEADER_1
        if len(buffer) - at < header:
            return INCOMPLETE
        if header_of(buffer, at).message_id not in self._seeds:
            return NO_PACKET
        length = header + buffer[at + 1] + CHECKSUM
        if header == HEADER_1:
            return length
        flags = buffer[at + 2]
        if flags & ~SIGNED:
            return NO_PACKET  # the standard: drop what has flags that are not understood
        return length + SIGNATURE * (flags & SIGNED)

    def intact(self, packet: bytes) -> bool:
        header = header_of(packet)
        (sent,) = struct.unpack_from("<H", packet, header.payload_end)
        seed = bytes([self._seeds[header.message_id]])
        return bool(self._crc(packet[1 : header.payload_end] + seed).crc == sent)

    def pieces(self, data: bytes) -> Iterator[tuple[Header | None, bytes]]:
        """The good packets of a datagram with their headers, and what lies between, without."""
        begin = at = 0
        while (at := self.find(data, at)) >= 0:
            length = self.length(data, at)
            whole = length > 0 and at + length <= len(data)
            if whole and self.intact(packet := data[at : at + length]):
                if at > begin:
                    yield None, data[begin:at]
                yield header_of(packet), packet
                begin = at = at + length
            else:
                at += 1
        if begin < len(data):
            yield None, data[begin:]


def header_of(buffer: bytes, at: int = 0) -> Header:
    """The header that starts at ``at``."""
    if buffer[at] == MARK_2:
        number = int.from_bytes(buffer[at + 7 : at + 10], "little")
        return Header(number, buffer[at + 5], buffer[at + 6], at + HEADER_2 + buffer[at + 1])
    return Header(buffer[at + 5], buffer[at + 3], buffer[at + 4], at + HEADER_1 + buffer[at + 1])
