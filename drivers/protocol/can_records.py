"""CAN frames in a stream of bytes: the records that :mod:`aquaflow.drivers.transport.can` makes.

A bus loses whole frames only. The checks are for recordings and for whatever else feeds a decoder.
"""

from __future__ import annotations

from typing import NamedTuple

from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing
from aquaflow.drivers.transport.can import EXTENDED, RECORD

MAX_STANDARD, MAX_EXTENDED = 0x7FF, 0x1FFF_FFFF
"""The largest identifiers of 11 and of 29 bits."""


class CanFrame(NamedTuple):
    """One frame of a CAN bus."""

    identifier: int
    extended: bool
    data: bytes


class CanFraming(Framing):
    """Records of 16 bytes, recognised by the bytes that must be zero."""

    longest = RECORD.size

    def find(self, buffer: bytes, at: int) -> int:
        return at

    def length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < RECORD.size:
            return INCOMPLETE
        identifier, length, payload = RECORD.unpack_from(buffer, at)
        allowed = EXTENDED | MAX_EXTENDED if identifier & EXTENDED else MAX_STANDARD
        padding = buffer[at + 5 : at + 8] + payload[length:]
        if identifier & ~allowed or length > len(payload) or any(padding):
            return NO_PACKET
        return RECORD.size

    def intact(self, packet: bytes) -> bool:
        return True  # the bus has tested its own checksum


def frame_of(record: bytes) -> CanFrame:
    """The frame in a record of :class:`CanFraming`."""
    identifier, length, payload = RECORD.unpack(record)
    return CanFrame(identifier & ~EXTENDED, bool(identifier & EXTENDED), payload[:length])
