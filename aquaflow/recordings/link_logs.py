"""MAVLink telemetry logs (.tlog): 64 bits of microseconds, big endian, before every packet."""

from __future__ import annotations

import re
from collections.abc import Iterator

from aquaflow.config.instruments import Nmea2000Config
from aquaflow.config.link import CanConfig, SerialConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig
from aquaflow.drivers.transport.can import EXTENDED, RECORD
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


# --------------------------------------------------------------------------------------------------
# CAN logs of ``candump -l``: ``(1436509053.249713) can0 09F50B23#0102030405060708``.

LINE = re.compile(r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#([0-9A-Fa-f]*)")
"""As candump -L writes it: seconds and their fraction, bus, identifier, data."""
EXTENDED_DIGITS = 8
"""Hexadecimal digits of a 29-bit identifier; one of 11 bits has three."""
MAX_DATA_BYTES = 8
"""Of a classic CAN frame."""


class Candump(ByteLog):
    """Data frames of one log, as the CAN link hands them over; other lines are skipped."""

    suffixes = frozenset({".candump", ".log"})

    @staticmethod
    def usual_device() -> AnyDevice:
        return Nmea2000Config(link=CanConfig(channel="log"))

    def reads(self) -> Iterator[Read]:
        clock, skipped = LogTime(self.starts_s), 0
        with self.path.open(encoding="ascii", errors="replace") as lines:
            for line in lines:
                record = _record(line)
                if record is None:
                    skipped += bool(line.strip())
                    continue
                yield Read(self.path.stem, clock.at(record[0]), record[1], record[0])
        self.notes = [f"{skipped} lines of {self.path.name} are no data frames"] if skipped else []


def _record(line: str) -> tuple[int, bytes] | None:
    """Stamp in ns and the frame as the kernel has it."""
    match = LINE.match(line)
    if match is None or len(match[5]) % 2 or len(match[5]) > 2 * MAX_DATA_BYTES:
        return None
    stamp_ns = int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0"))
    flag = EXTENDED if len(match[4]) == EXTENDED_DIGITS else 0
    data = bytes.fromhex(match[5])
    return stamp_ns, RECORD.pack(int(match[4], 16) | flag, len(data), data.ljust(8, b"\0"))
