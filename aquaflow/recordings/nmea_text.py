"""NMEA 0183 as text, a sentence a line, after the time of its arrival where the logger wrote one.

``1372687208.47 $SDDBT,...`` and ``2013-07-01T14:00:08.47Z $SDDBT,...`` are read, with a comma, tab
or space between. Where no line has a time, lines are spread evenly, ``LINES_HZ`` of them a second.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone

from aquaflow.config.link import SerialConfig
from aquaflow.config.telemetry import AnyDevice, NmeaConfig
from aquaflow.recordings.telemetry_log import ByteLog, LogTime, Read

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
        if None in stamps:
            self.notes.append(f"{stamps.count(None)} lines of {self.path.name} have no time")
        clock = LogTime(self.starts_s)
        for (_, match), stated_ns, stamp_ns in zip(matches, stamps, _fill(stamps), strict=True):
            sentence = match[0] + b"\r\n"
            yield Read(self.path.stem, clock.at(stamp_ns), sentence, stated_ns)


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
