"""CAN logs of ``candump -l``: ``(1436509053.249713) can0 09F50B23#0102030405060708``."""

from __future__ import annotations

import re
from collections.abc import Iterator

from aquaflow.config.instruments import Nmea2000Config
from aquaflow.config.link import CanConfig
from aquaflow.config.telemetry import AnyDevice
from aquaflow.drivers.transport.can import EXTENDED, RECORD
from aquaflow.recordings.telemetry_log import ByteLog, LogTime, Read

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
