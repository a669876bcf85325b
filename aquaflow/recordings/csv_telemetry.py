"""Tables of telemetry: what ``aquaflow lab synth`` writes, ``rostopic echo -p``, GoPro extracts,
and plain tables of a survey."""

from __future__ import annotations

import contextlib
import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TypeAlias

from aquaflow.base.errors import InputError
from aquaflow.drivers.samples import from_euler, plausible, sigma_of
from aquaflow.recordings.sample_table import HEADER, read_telemetry
from aquaflow.recordings.telemetry_log import LoggedUtc, LogTime, TelemetryLog
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    Velocity,
)

Line: TypeAlias = dict[str, str]
Convert: TypeAlias = Callable[[Line, int, int, str], list[TelemetrySample]]
Samples: TypeAlias = Iterator[TelemetrySample]

NAVQUEST_SHARE, NAVQUEST_SIGMA_M_S = 0.002, 0.001
"""LinkQuest NavQuest 600, data sheet: 0.2 % of the velocity and 1 mm/s."""

TIME, STAMP = "%time", "field.header.stamp"
"""Columns of a table that rostopic echo -p wrote: when a message was recorded, and measured; ns."""


class CsvTelemetry(TelemetryLog):
    """One table; the header says which. Velocities are in the instrument's own axes."""

    suffixes = frozenset({".csv"})

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return super().recognises(path) and _reader_of(path) is not None

    @classmethod
    def refusal(cls, path: Path) -> str | None:
        """Why the table at ``path`` cannot be read; None if it can, or is no table."""
        if not super().recognises(path) or cls.recognises(path):
            return None
        return why_no_survey_table(path)

    def samples(self) -> Iterator[TelemetrySample]:
        """Samples in the order of the lines; a line that holds no numbers is skipped.

        Raises:
            InputError: the table's header is not known.
        """
        reader = _reader_of(self.path)
        if reader is None:
            raise InputError(f"{self.path} is no table of telemetry that AquaFlow knows")
        self.notes = []
        yield from reader(self)

    def lines(self, convert: Convert, stamps_of: Callable[[Line], tuple[int, int]]) -> Samples:
        """Every line converted; ``stamps_of`` gives arrival and measurement, ns."""
        clock, bad = LogTime(self.starts_s), 0
        with self.path.open(newline="", encoding="utf-8", errors="replace") as file:
            for line in self._as_far_as_it_is_a_table(csv.DictReader(file)):
                try:
                    arrival_stamp, stamp = stamps_of(line)
                    arrival_ns = clock.at(arrival_stamp)
                    t_ns = arrival_ns + min(stamp - arrival_stamp, 0)
                    found = convert(line, t_ns, arrival_ns, self.path.stem)
                except (KeyError, TypeError, ValueError, OverflowError):
                    bad += 1
                    continue
                yield from found
        self._note_left_out(bad)

    def survey(self) -> Samples:
        """A plain table; times of ``t_s`` stay as they are, those of ``utc`` count from the first
        row."""
        source, bad = self.path.stem, 0
        times = list(self._survey_times())
        utc = LoggedUtc(source, iter([time for time in times if time is not None]))
        self.notes += unused_columns(self.path)
        with self.path.open(encoding="utf-8-sig", errors="replace") as file:
            rows = self._as_far_as_it_is_a_table(rows_of(file))
            for row, time in zip(rows, times, strict=False):
                try:
                    if time is None:
                        raise ValueError("no time")
                    found = samples_of(row, time[0], source)
                except (TypeError, ValueError):
                    bad += 1
                    continue
                yield from utc.at(*time)
                yield from found
        self._note_left_out(bad)

    def _survey_times(self) -> Iterator[tuple[int, int | None] | None]:
        """Of every row: time in the dive and UTC, ns; None where it states none."""
        clock, newest_ns = LogTime(self.starts_s), -(10**18)
        with (
            self.path.open(encoding="utf-8-sig", errors="replace") as file,
            contextlib.suppress(csv.Error),
        ):
            for row in rows_of(file):
                try:
                    if UTC in row:
                        wall_ns = utc_ns(row[UTC])
                        yield clock.at(wall_ns), wall_ns
                        continue
                    t_s = self.starts_s + float(row[SECONDS])
                    newest_ns = max(newest_ns, round(t_s * 1e9))
                    yield newest_ns, None
                except (AttributeError, TypeError, ValueError, OverflowError):
                    yield None

    def _note_left_out(self, lines: int) -> None:
        if lines:
            self.notes.append(f"{lines} lines of {self.path.name} were left out")

    def _as_far_as_it_is_a_table(self, lines: Iterator[Line]) -> Iterator[Line]:
        """Lines before the first of more than 131,072 characters in a field, csv's limit."""
        number = 1
        try:
            for line in lines:
                number += 1
                yield line
        except csv.Error:
            self.notes.append(
                f"{self.path.name} is damaged after line {number}; the rest was left out"
            )


Reader: TypeAlias = Callable[[CsvTelemetry], Samples]


def _reader_of(path: Path) -> Reader | None:
    """How to read the table, by its header."""
    header = header_of(path)
    ros, gopro = header[:1] == (TIME,), header == ("t_s", "c0", "c1", "c2")
    stream = path.stem.rpartition("_")[2]
    known: list[tuple[bool, Reader]] = [
        (header == HEADER, _synthetic),
        (is_survey_table(header), CsvTelemetry.survey),
        (ros and "field.depth" in header, lambda table: table.lines(_ros_depth, _ros_stamps)),
        (
            ros and "field.velocityInst0" in header,
            lambda table: table.lines(_ros_dvl, _ros_stamps),
        ),
        (gopro and stream == "gyro", lambda table: table.lines(_gopro_rate, _gopro_stamps)),
        (gopro and stream == "accl", lambda table: table.lines(_gopro_force, _gopro_stamps)),
    ]
    return next((reader for fits, reader in known if fits), None)


def _synthetic(table: CsvTelemetry) -> Samples:
    """Its times are those of its dive's pictures, not from the first line on."""
    shift_ns = round(table.starts_s * 1e9)
    for sample in read_telemetry(table.path):
        t_ns, arrival_ns = sample.t_ns + shift_ns, sample.arrival_ns + shift_ns
        yield replace(sample, t_ns=t_ns, arrival_ns=arrival_ns)


def _ros_stamps(line: Line) -> tuple[int, int]:
    return int(line[TIME]), int(line.get(STAMP) or line[TIME])


def _gopro_stamps(line: Line) -> tuple[int, int]:
    stamp = round(float(line["t_s"]) * 1e9)
    return stamp, stamp


def _numbers(line: Line, *columns: str) -> tuple[float, ...]:
    numbers = tuple(float(line[column]) for column in columns)
    if not all(map(math.isfinite, numbers)):
        raise ValueError("not finite")
    return numbers


def _ros_depth(line: Line, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    (depth_m,) = _numbers(line, "field.depth")
    return [Depth(t_ns, arrival_ns, source, depth_m)]


def _ros_dvl(line: Line, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    """LinkQuest's message: velocity over ground where the flag is 1; altitude 0 means none."""
    found: list[TelemetrySample] = []
    if line["field.velocityInstFlag"] == "1":
        x, y, z = _numbers(line, *(f"field.velocityInst{axis}" for axis in range(3)))
        sigma = NAVQUEST_SHARE * math.hypot(x, y, z) + NAVQUEST_SIGMA_M_S
        found.append(Velocity(t_ns, arrival_ns, source, (x, y, z), sigma))
    (altitude_m,) = _numbers(line, "field.altitude")
    if altitude_m > 0.0:
        found.append(Altitude(t_ns, arrival_ns, source, altitude_m))
    return found


def _gopro_body(line: Line) -> tuple[float, float, float]:
    """GoPro's axes in those of the camera's body: forward, right, down.

    Found by fitting the gyro of shared/data/reef_clip to the rotations of its poses_sfm.tum; the
    accelerometer then shows gravity downwards and a camera that looks 23 degrees down.
    """
    c0, c1, c2 = _numbers(line, "c0", "c1", "c2")
    return -c2, -c1, -c0


def _gopro_rate(line: Line, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    return [AngularRate(t_ns, arrival_ns, source, _gopro_body(line))]


def _gopro_force(line: Line, t_ns: int, arrival_ns: int, source: str) -> list[TelemetrySample]:
    return [Acceleration(t_ns, arrival_ns, source, _gopro_body(line))]


# --------------------------------------------------------------------------------------------------
# Rows of a plain table of telemetry, with the quantities of a survey's log by the header.
#
# A row has a time, ``t_s`` (seconds after the recording's first picture) or ``utc`` (ISO 8601,
# UTC where it states no offset), and any of the columns of ``QUANTITIES``. Empty cells say
# nothing. A spreadsheet of a country with decimal commas separates by semicolons.

SECONDS, UTC = "t_s", "utc"
"""Columns with a row's time; a table has one of them."""
PLACE = ("latitude_deg", "longitude_deg")
ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
QUANTITIES = (*PLACE, "sigma_m", "depth_m", *ANGLES, "altitude_m")
"""Columns with what was measured, in any order."""
SEPARATORS = ",;\t"
LONGEST_HEADER = 10_000
"""Characters of a header that are read: what is longer is no table of telemetry."""

Row: TypeAlias = dict[str, str]


def header_of(path: Path) -> tuple[str, ...]:
    """Names of the table's columns; none if the file cannot be read."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return tuple(_names(file.readline(LONGEST_HEADER))[0])
    except OSError:
        return ()


def _names(line: str) -> tuple[list[str], str]:
    """Names of the columns in a header, and what separates them."""
    separator = max(SEPARATORS, key=line.count)
    try:
        names = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        names = []
    return [name.strip() for name in names], separator


def rows_of(file: Iterator[str]) -> Iterator[Row]:
    """Rows below the header, numbers with a decimal point.

    Raises:
        csv.Error: from the row on at which the file is no table.
    """
    names, separator = _names(next(file, "")[:LONGEST_HEADER])
    rows = csv.DictReader(file, names, restkey=BEYOND, delimiter=separator, skipinitialspace=True)
    if separator == ",":
        return iter(rows)
    return ({name: _with_point(cell) for name, cell in row.items()} for row in rows)


BEYOND = "beyond the header"
"""The name of cells that no column has."""


def _with_point(cell: str | None) -> str:
    return cell.replace(",", ".") if isinstance(cell, str) else ""


def is_survey_table(header: tuple[str, ...]) -> bool:
    """True if one column is a time, and another something that was measured."""
    columns = set(header)
    times, measured = columns & {SECONDS, UTC}, columns & set(QUANTITIES) - {"sigma_m"}
    return len(times) == 1 and bool(measured)


def unused_columns(path: Path) -> list[str]:
    """Sentences about columns of a survey's table that say nothing, each with the reason."""
    columns = header_of(path)
    unknown = [name for name in columns if name not in (SECONDS, UTC, *QUANTITIES)]
    notes = []
    if unknown:
        notes.append(
            f"{path.name} has columns that AquaFlow does not know and did not use: "
            f"{', '.join(unknown)}; those it knows are {', '.join(QUANTITIES)}"
        )
    for together in (PLACE, ANGLES):
        there = [name for name in together if name in columns]
        if there and len(there) < len(together):
            missing = [name for name in together if name not in columns]
            notes.append(
                f"{', '.join(there)} of {path.name} could not be used without {', '.join(missing)}"
            )
    return notes


def why_no_survey_table(path: Path) -> str:
    """One sentence on what the table at ``path`` lacks."""
    columns = set(header_of(path))
    known = f"{SECONDS} (seconds after the first picture) or {UTC} (ISO 8601)"
    if not columns & set(QUANTITIES):
        return (
            f"{path} has none of the columns of a table of telemetry; name its columns "
            f"{known}, and any of {', '.join(QUANTITIES)}"
        )
    if columns >= {SECONDS, UTC}:
        return f"{path} has two columns of time, {SECONDS} and {UTC}; leave the right one"
    if not columns & {SECONDS, UTC}:
        return f"{path} has no column of time; name it {known}"
    return f"{path} has nothing that was measured; add any of {', '.join(QUANTITIES)}"


def utc_ns(text: str) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time, to the microsecond.

    Raises:
        ValueError: it is none.
    """
    moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
    since = aware - datetime(1970, 1, 1, tzinfo=timezone.utc)
    return 1000 * ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds)


def samples_of(row: Row, t_ns: int, source: str) -> list[TelemetrySample]:
    """Samples of one row; angles make an attitude only together.

    Raises:
        ValueError: a cell holds no number, or one that no vehicle can have.
    """
    known = {name: float(row[name]) for name in QUANTITIES if (row.get(name) or "").strip()}
    stamp = (t_ns, t_ns, source)
    found: list[TelemetrySample] = []
    if known.keys() >= set(PLACE):
        place = known["latitude_deg"], known["longitude_deg"]
        found.append(Position(*stamp, *place, known.get("sigma_m", sigma_of(None))))
    if "depth_m" in known:
        found.append(Depth(*stamp, known["depth_m"]))
    if known.keys() >= set(ANGLES):
        found.append(Attitude(*stamp, from_euler(*(math.radians(known[a]) for a in ANGLES))))
    if "altitude_m" in known:
        found.append(Altitude(*stamp, known["altitude_m"]))
    if not all(map(plausible, found)):
        raise ValueError("no vehicle can have these values")
    return found
