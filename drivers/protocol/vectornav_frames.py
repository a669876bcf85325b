"""Messages of a VectorNav on the wire: binary with the groups of fields that it was set to, ASCII.

VN-100 User Manual (UM001, revision 2.22), sections 3.8 and 4.3; a VN-200 or VN-300 sends the same
with more groups.
"""

from __future__ import annotations

import binascii
import re
import struct
from functools import reduce
from operator import xor
from typing import NamedTuple

from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing

SYNC = 0xFA
"""First byte of a binary message."""
MARKS = re.compile(rb"[\xfa$]")
"""First bytes of messages."""
CRC = 2
"""Bytes at a binary message's end."""
LONGEST = 1024
"""Bytes; all fields of all groups have some 900."""
LONGEST_LINE = 256
"""Bytes of an ASCII message; VNISE has some 200."""
LINE = re.compile(rb"\$(VN[\x20-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})[\r\n]")
"""What the checksum covers, and its digits: two of an exclusive or, or four of a CRC."""
EXTENDED_GROUPS, EXTENDED_FIELDS = 0x80, 0x8000
"""Bits that announce a further byte of groups, a further word of fields; reserved until now."""
FIELD_BYTES = (
    (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    (8, 8, 8, 2, 8, 8, 8, 4, 4, 1, 1),
    (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
    (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24),
    (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
)
"""Of groups 1 to 7 by bit. Lists of satellites (bits 14 and 15 of groups 4 and 7) have no fixed
length and are not read."""


class Field(NamedTuple):
    """A field of a binary message."""

    group: int
    """1 to 7."""
    bit: int


class VectorNavFraming(Framing):
    """Binary and ASCII messages, mixed as the instrument sends them."""

    longest = LONGEST
    padding = b"\r\n"

    def find(self, buffer: bytes, at: int) -> int:
        found = MARKS.search(buffer, at)
        return found.start() if found else -1

    def length(self, buffer: bytes, at: int) -> int:
        if buffer[at] == SYNC:
            return _binary_length(buffer, at)
        ends = [buffer.find(end, at + 1, at + LONGEST_LINE) for end in (b"\r", b"\n")]
        if max(ends) > 0:
            return min(end for end in ends if end > 0) + 1 - at
        return NO_PACKET if len(buffer) - at >= LONGEST_LINE else INCOMPLETE

    def intact(self, packet: bytes) -> bool:
        if packet[0] == SYNC:
            return binascii.crc_hqx(packet[1:], 0) == 0
        match = LINE.fullmatch(packet)
        if match is None:
            return False
        body, digits = match.groups()
        right = reduce(xor, body, 0) if len(digits) == 2 else binascii.crc_hqx(body, 0)
        return int(digits, 16) == right


def fields_of(packet: bytes) -> dict[Field, bytes]:
    """The fields of an intact binary message."""
    masks, at = _masks(packet, 0)
    found = {}
    for group, mask in masks.items():
        for bit, size in enumerate(FIELD_BYTES[group - 1]):
            if mask >> bit & 1:
                found[Field(group, bit)] = packet[at : at + size]
                at += size
    return found


def line_of(packet: bytes) -> tuple[str, list[str]]:
    """Kind and fields of an intact ASCII message; a counter or status that is appended is left."""
    match = LINE.fullmatch(packet)
    assert match is not None
    kind, *fields = match.group(1).decode("ascii").split(",")
    return kind, fields


def _binary_length(buffer: bytes, at: int) -> int:
    if len(buffer) - at < 2:
        return INCOMPLETE
    groups = buffer[at + 1]
    header = 2 + 2 * groups.bit_count()
    if groups == 0 or groups & EXTENDED_GROUPS:
        return NO_PACKET
    if len(buffer) - at < header:
        return INCOMPLETE
    masks, _ = _masks(buffer, at)
    size = 0
    for group, mask in masks.items():
        sizes = FIELD_BYTES[group - 1]
        if mask == 0 or mask & EXTENDED_FIELDS or mask >> len(sizes):
            return NO_PACKET
        size += sum(each for bit, each in enumerate(sizes) if mask >> bit & 1)
    return header + size + CRC


def _masks(buffer: bytes, at: int) -> tuple[dict[int, int], int]:
    """The fields of each group that is there, and where the values begin."""
    groups = [number for number in range(1, 8) if buffer[at + 1] >> (number - 1) & 1]
    masks = struct.unpack_from(f"<{len(groups)}H", buffer, at + 2)
    return dict(zip(groups, masks, strict=True)), at + 2 + 2 * len(groups)
