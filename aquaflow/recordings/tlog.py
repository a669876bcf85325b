"""MAVLink telemetry logs (.tlog): 64 bits of microseconds, big endian, before every packet."""

from __future__ import annotations

import re
from collections.abc import Iterator

from aquaflow.config.link import SerialConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig
from aquaflow.recordings.telemetry_log import LONGEST_PAUSE_NS, ByteLog, LogTime, Read

STAMP_BYTES = 8
"""Microseconds since 1970 before every packet, big-endian."""
MAVLINK_1, MAVLINK_2 = 0xFE, 0xFD
"""First bytes of a packet of either version."""
MARKS = re.compile(rb"[\xfd\xfe]")
"""First bytes of a packet."""
FRAMING_BYTES = {MAVLINK_1: 8, MAVLINK_2: 12}
"""Of a packet without payload: header and checksum."""
SIGNED_FLAG, SIGNATURE_BYTES = 0x01, 13
"""Flag of a packet that a signature follows, and the signature's length."""
SHORTEST = STAMP_BYTES + 3
"""Bytes from which a packet's length can be read: stamp, first byte, length and flags."""


class Tlog(ByteLog):
    """What a ground station or pymavlink logged."""

    suffixes = frozenset({".tlog"})

    @staticmethod
    def usual_device() -> AnyDevice:
        return MavlinkConfig(link=SerialConfig(port="log"))

    def reads(self) -> Iterator[Read]:
        """One packet each; where a length was damaged, the search for the next stamp begins."""
        data = self.path.read_bytes()
        clock, link = LogTime(self.starts_s), self.path.stem
        at, stamp_us = 0, None
        skipped = 0
        while at + SHORTEST <= len(data):
            found_us = int.from_bytes(data[at : at + STAMP_BYTES], "big")
            length = _packet_bytes(data, at + STAMP_BYTES)
            near = stamp_us is None or abs(found_us - stamp_us) * 1000 <= LONGEST_PAUSE_NS
            if length == 0 or not (near or _leads_on(data, at, length)):
                mark = MARKS.search(data, at + 1 + STAMP_BYTES)
                following = len(data) if mark is None else mark.start() - STAMP_BYTES
                skipped += following - at
                at = following
                continue
            stamp_us = found_us
            packet = data[at + STAMP_BYTES : at + STAMP_BYTES + length]
            wall_ns = 1000 * found_us
            yield Read(link, clock.at(wall_ns), packet, wall_ns)
            at += STAMP_BYTES + length
        self.notes = [f"{skipped} bytes of {self.path.name} belong to no record"] if skipped else []
        if clock.jumps:
            self.notes.append(
                f"the clock of {self.path.name} was set {clock.jumps} times and gives no UTC"
            )


def _packet_bytes(data: bytes, at: int) -> int:
    """Length of the packet at ``at``; 0 if none starts there."""
    if data[at] not in FRAMING_BYTES:
        return 0
    signed = data[at] == MAVLINK_2 and data[at + 2] & SIGNED_FLAG
    return FRAMING_BYTES[data[at]] + data[at + 1] + (SIGNATURE_BYTES if signed else 0)


def _leads_on(data: bytes, at: int, length: int) -> bool:
    """True if another packet follows, as it does where only the clock was set."""
    following = at + STAMP_BYTES + length + STAMP_BYTES
    return following + 2 < len(data) and _packet_bytes(data, following) > 0
