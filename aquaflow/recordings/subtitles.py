"""Subtitle tracks (.ass) that QGroundControl and Cockpit write beside their recordings.

Both write one entry a second, for the player's overlay: what the pilot had on the screen. Layouts
as read in QGroundControl's SubtitleWriter.cc (2020 to 2026) and Cockpit's sensors-logging.ts (2024
to 2026):

- QGroundControl: for each of three columns a dialogue of names (``Roll:\\N Pitch:``) and one of
  values with units (``1.5 deg\\N-3.0 deg``), and one with the local date, which is no UTC. An entry
  is written when its second is over, so its values are of its end.
- Cockpit: for each of nine places a dialogue of lines ``Roll: 1.5 °``, and the date and the time
  with its offset from UTC as lines without a name. Values are of the beginning of the entry.

Which quantities there are is the pilot's choice. Depth is shown as an altitude, negative in the
water, by QGroundControl and by earlier versions of Cockpit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from datetime import datetime
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import NamedTuple

from aquaflow.drivers.samples import from_euler, plausible, sigma_of
from aquaflow.recordings.telemetry_log import UTC_EVERY_NS, TelemetryLog
from aquaflow.types import Altitude, Attitude, Depth, Position, TelemetrySample, UtcTime

TITLE = re.compile(r"^\s*Title: (QGroundControl|Cockpit) Subtitle Telemetry file")
"""Line of the header by which both are recognised."""
HEADER_CHARACTERS = 2000
"""The title is the second line."""
DIALOGUE = re.compile(
    r"\s*Dialogue: [^,]*,(\d+):(\d\d):(\d\d\.\d\d),(\d+):(\d\d):(\d\d\.\d\d),(?:[^,]*,){6}(.*)"
)
"""Begin, end and text; between them style, name, three margins and effect."""
OVERRIDE = re.compile(r"\{[^}]*\}")
"""Instructions for the player."""
VALUE = re.compile(r"\s*(-?\d+(?:\.\d+)?)\s*([^\d\s]*)\s*")
"""A number and its unit."""
UNITS = {"m": 1.0, "ft": 0.3048, "°": 1.0, "deg": 1.0, "": 1.0}
"""To metres and degrees."""
QUANTITIES = {
    "Roll": "roll", "Pitch": "pitch", "Heading": "heading", "Depth": "depth",
    "Latitude": "latitude", "Longitude": "longitude", "Rangefinder": "altitude",
}  # fmt: skip
"""By the name on the screen. QGroundControl's altitude is that over the sea, not over ground."""
DATE = re.compile(r"[A-Z][a-z]{2} \d\d, \d{4}")
TIME = re.compile(r"(\d\d:\d\d:\d\d) GMT(?:([+-])(\d{1,2})(?::(\d\d))?)?")
"""As Cockpit writes them: ``Nov 22, 2026`` and ``14:03:07 GMT-3``."""
WHOLE_SECOND = 1.0
"""s; Cockpit cuts off the fraction."""


class SubtitleEntry(NamedTuple):
    """What the screen showed."""

    t_s: float
    values: dict[str, float]
    utc_s: int | None


class Subtitles(TelemetryLog):
    """Depth, attitude, position and altitude once a second; UTC from Cockpit."""

    suffixes = frozenset({".ass"})

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return super().recognises(path) and _writer(path) is not None

    def samples(self) -> Iterator[TelemetrySample]:
        """In the order of the video, whose first picture is at ``starts_s``."""
        entries, bad = list(self._entries()), 0
        depths = [entry.values["depth"] for entry in entries if "depth" in entry.values]
        downwards = -1.0 if depths and median(depths) < 0.0 else 1.0
        begins_s, due_ns = self._video_began(entries), -math.inf
        for entry in entries:
            t_ns = round((self.starts_s + entry.t_s) * 1e9)
            found = _samples(entry.values, downwards, t_ns, self.path.stem)
            if begins_s is not None and t_ns >= due_ns:
                utc_ns = round(begins_s * 1e3) * 1_000_000 + round(entry.t_s * 1e9)
                found.append(UtcTime(t_ns, t_ns, self.path.stem, utc_ns))
                due_ns = t_ns + UTC_EVERY_NS
            sound = [sample for sample in found if plausible(sample)]
            bad += len(sound) < len(found)
            yield from sound
        if bad:
            self.notes.append(f"{bad} entries of {self.path.name} hold no sane values")

    def _entries(self) -> Iterator[SubtitleEntry]:
        self.notes = []
        later = _writer(self.path) == "QGroundControl"
        with self.path.open(encoding="utf-8", errors="replace") as file:
            matches = (match for line in file if (match := DIALOGUE.match(line)) is not None)
            newest_s = 0.0
            for _, dialogues in groupby(matches, key=lambda match: match.group(1, 2, 3)):
                shown = list(dialogues)
                hours, minutes, seconds = shown[0].group(*((4, 5, 6) if later else (1, 2, 3)))
                newest_s = max(3600 * int(hours) + 60 * int(minutes) + float(seconds), newest_s)
                texts = [OVERRIDE.sub("", match[7]).split(r"\N") for match in shown]
                yield SubtitleEntry(newest_s, *_read(texts))

    def _video_began(self, entries: list[SubtitleEntry]) -> float | None:
        """UTC of the first picture: a time that was cut to a second is early by less than one, so
        the latest of all is the nearest. None where the clock was set on the way."""
        began_s = [entry.utc_s - entry.t_s for entry in entries if entry.utc_s is not None]
        if not began_s:
            return None
        if max(began_s) - min(began_s) > 2.0 * WHOLE_SECOND:
            self.notes.append(f"the clock of {self.path.name} was set and gives no UTC")
            return None
        return max(began_s)


def _writer(path: Path) -> str | None:
    """The program that wrote the file; None if neither did."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            header = file.read(HEADER_CHARACTERS)
    except OSError:
        return None
    found = next(filter(None, map(TITLE.match, header.splitlines())), None)
    return None if found is None else found[1]


def _read(texts: list[list[str]]) -> tuple[dict[str, float], int | None]:
    """Quantities in metres and degrees, and the second of UTC, of the lines of all dialogues."""
    shown: dict[str, str] = {}
    days: list[str] = []
    clocks: list[re.Match[str]] = []
    for lines, following in zip(texts, [*texts[1:], []], strict=True):
        if all(line.rstrip().endswith(":") for line in lines) and len(lines) == len(following):
            names = (line.strip().rstrip(":") for line in lines)
            shown |= dict(zip(names, following, strict=True))
        for line in lines:
            name, _, value = line.partition(": ")
            shown |= {name.strip(): value}
            days += DATE.findall(line)
            clocks += [match for match in [TIME.search(line)] if match]
    values = {}
    for name, text in shown.items():
        match = VALUE.fullmatch(text)
        if name in QUANTITIES and match is not None and match[2] in UNITS:
            values[QUANTITIES[name]] = float(match[1]) * UNITS[match[2]]
    return values, _utc_s(days[0], clocks[0]) if days and clocks else None


def _utc_s(day: str, clock: re.Match[str]) -> int | None:
    try:
        local = datetime.strptime(f"{day} {clock[1]} +0000", "%b %d, %Y %H:%M:%S %z")
    except ValueError:
        return None
    east_s = 3600 * int(clock[3] or 0) + 60 * int(clock[4] or 0)
    return int(local.timestamp()) - (-east_s if clock[2] == "-" else east_s)


def _samples(
    values: dict[str, float], downwards: float, t_ns: int, source: str
) -> list[TelemetrySample]:
    stamp = (t_ns, t_ns, source)
    found: list[TelemetrySample] = []
    if "depth" in values:
        found.append(Depth(*stamp, downwards * values["depth"]))
    if {"roll", "pitch", "heading"} <= values.keys():
        angles = [math.radians(values[angle]) for angle in ("roll", "pitch", "heading")]
        found.append(Attitude(*stamp, from_euler(*angles)))
    if "altitude" in values:
        found.append(Altitude(*stamp, values["altitude"]))
    if {"latitude", "longitude"} <= values.keys() and (values["latitude"] or values["longitude"]):
        place = values["latitude"], values["longitude"]
        found.append(Position(*stamp, *place, sigma_of(None)))
    return found
