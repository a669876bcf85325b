"""NMEA 0183 sentences: ``$IIHDT,271.3,T*2C`` and a line end.

Own framing, because a shared line brings half sentences; pynmea2 adds only names to what
:mod:`aquaflow.drivers.protocol.nmea` reads.
"""

from __future__ import annotations

import re
from functools import reduce
from operator import xor
from typing import NamedTuple

from aquaflow.drivers.protocol.packets import LineFraming

LONGEST = 256
"""Bytes. The standard has 82; proprietary sentences are longer."""
BODY = re.compile(rb"[$!]([\x20-\x7e]*?)(?:\*([0-9A-Fa-f]{2}))?[ \t]*[\r\n]")
"""A sentence: what the checksum covers, and the two digits of it, if there are any."""


class Sentence(NamedTuple):
    """``talker`` is empty for proprietary sentences, whose ``kind`` starts with P."""

    talker: str
    kind: str
    fields: list[str]


def checksum(body: bytes) -> int:
    """Of what stands between the mark and the star."""
    return reduce(xor, body, 0)


def framing(require_checksum: bool) -> LineFraming:
    """Finds sentences in a stream; ``require_checksum`` drops those that carry none."""

    def intact(packet: bytes) -> bool:
        match = BODY.fullmatch(packet)
        if match is None:
            return False
        body, sent = match.groups()
        if sent is None:
            return not require_checksum
        return checksum(body) == int(sent, 16)

    return LineFraming(b"$!", LONGEST, intact)


def parse(packet: bytes) -> Sentence:
    """Parse an intact sentence."""
    match = BODY.fullmatch(packet)
    assert match is not None
    address, *fields = match.group(1).decode("ascii").split(",")
    if address.startswith("P"):
        return Sentence("", address, fields)
    return Sentence(address[:-3], address[-3:], fields)


def number(field: str) -> float:
    """ValueError for an empty field, which is how NMEA says 'not available'."""
    return float(field)
