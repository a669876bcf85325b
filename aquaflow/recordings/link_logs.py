"""Logs of single links: MAVLink (.tlog), CAN (candump) and NMEA 0183 as text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone

from aquaflow.base.errors import times
from aquaflow.config.instruments import Nmea2000Config
from aquaflow.config.link import CanConfig, SerialConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig, NmeaConfig
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
                f"the clock of {self.path.name} was set {times(clock.jumps)} and gives no UTC"
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


# --------------------------------------------------------------------------------------------------
# NMEA 0183 as text, a sentence a line, after the time of its arrival where the logger wrote one.
#
# ``1372687208.47 $SDDBT,...`` and ``2013-07-01T14:00:08.47Z $SDDBT,...`` are read, with a comma,
# tab or space between. Where no line has a time, that in the sentences themselves is used; where
# those have none either, lines are spread evenly, ``LINES_HZ`` of them a second, which is noted.

SENTENCE = re.compile(rb"[$!][^$!\r\n]*")
"""A sentence on a line, whatever stands before it."""
LINES_HZ = 10
"""A guess: a compass talks at 10 Hz, a sounder at 1 to 10."""


class NmeaText(ByteLog):
    """Sentences of one log, through the decoder of a serial link."""

    suffixes = frozenset({".nmea", ".txt"})

    @staticmethod
    def usual_device() -> AnyDevice:
        return NmeaConfig(link=SerialConfig(port="log"))

    def reads(self) -> Iterator[Read]:
        matches = [
            (line, match)
            for line in self.path.read_bytes().splitlines()
            if (match := SENTENCE.search(line)) is not None
        ]
        stamps = [_stamp_ns(line[: match.start()]) for line, match in matches]
        self.notes = []
        moments = list(stamps)
        if stamps and set(stamps) == {None}:
            moments = _sentence_times([match[0] for _, match in matches])
            self.notes.append(
                f"no line of {self.path.name} has the time of its arrival: "
                + (
                    f"{LINES_HZ} lines a second are assumed"
                    if set(moments) == {None}
                    else "the UTC in its sentences is used"
                )
            )
        elif None in stamps:
            self.notes.append(f"{stamps.count(None)} lines of {self.path.name} have no time")
        clock = LogTime(self.starts_s)
        for (_, match), stated_ns, stamp_ns in zip(matches, stamps, _fill(moments), strict=True):
            sentence = match[0] + b"\r\n"
            yield Read(self.path.stem, clock.at(stamp_ns), sentence, stated_ns)


UTC_FIELD = {b"GGA": 1, b"RMC": 1, b"ZDA": 1, b"GNS": 1, b"GST": 1, b"GBS": 1, b"GLL": 5}
"""Sentences with UTC, and which of their fields it is (NMEA 0183)."""
UTC = re.compile(rb"([01]\d|2[0-3])([0-5]\d)([0-6]\d)(?:\.(\d{1,9}))?")
"""hhmmss.ss."""
DAY_NS = 86_400 * 1_000_000_000
"""Sentences count from midnight."""


def _sentence_times(sentences: list[bytes]) -> list[int | None]:
    """ns from the first midnight, as the sentences say it; None for those without UTC."""
    times: list[int | None] = []
    days, last = 0, 0
    for sentence in sentences:
        fields = sentence.split(b"*")[0].split(b",")
        at = UTC_FIELD.get(fields[0][-3:], len(fields))
        found = UTC.fullmatch(fields[at]) if at < len(fields) else None
        if found is None:
            times.append(None)
            continue
        hours, minutes, seconds = (int(part) for part in found.groups()[:3])
        whole = 3600 * hours + 60 * minutes + seconds
        now = whole * 1_000_000_000 + int((found[4] or b"").ljust(9, b"0"))
        days += now < last - DAY_NS // 2
        last = now
        times.append(days * DAY_NS + now)
    return times


def _fill(stamps: list[int | None]) -> list[int]:
    """Lines without a time have that of the line before; evenly spread if no line has one."""
    last = next((stamp for stamp in stamps if stamp is not None), None)
    if last is None:
        return [number * 1_000_000_000 // LINES_HZ for number in range(len(stamps))]
    filled: list[int] = []
    for stamp in stamps:
        last = last if stamp is None else stamp
        filled.append(last)
    return filled


def _stamp_ns(before: bytes) -> int | None:
    """Nanoseconds since 1970, or since whenever the logger counts from."""
    word = before.decode("ascii", "replace").strip(" \t,;[]")
    try:
        seconds, _, fraction = word.partition(".")
        return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(word.replace("Z", "+00:00"))
    except ValueError:
        return None
    aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
    return round(aware.timestamp() * 1e6) * 1000
