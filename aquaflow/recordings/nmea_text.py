"""NMEA 0183 as text, a sentence a line, after the time of its arrival where the logger wrote one.

``1372687208.47 $SDDBT,...`` and ``2013-07-01T14:00:08.47Z $SDDBT,...`` are read, with a comma, tab
or space between. Where no line has a time, that in the sentences themselves is used; where those
have none either, lines are spread evenly, ``LINES_HZ`` of them a second, which is noted.
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
