"""Protocols of printable lines: a mark at the start, a line end, a checksum in hexadecimal."""

from __future__ import annotations

import re
from collections.abc import Callable

from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing


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
