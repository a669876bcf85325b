"""Rows of a plain table of telemetry, with the quantities of a survey's log by the header.

A row has a time, ``t_s`` (seconds after the recording's first picture) or ``utc`` (ISO 8601, UTC
where it states no offset), and any of the columns of ``QUANTITIES``. Empty cells say nothing.
"""

from __future__ import annotations

import math
from datetime import datetime, timezone
from typing import TypeAlias

from aquaflow.drivers.samples import from_euler, plausible, sigma_of
from aquaflow.types import Altitude, Attitude, Depth, Position, TelemetrySample

SECONDS, UTC = "t_s", "utc"
"""Columns with a row's time; a table has one of them."""
PLACE = ("latitude_deg", "longitude_deg")
ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
QUANTITIES = (*PLACE, "sigma_m", "depth_m", *ANGLES, "altitude_m")
"""Columns with what was measured, in any order."""

Row: TypeAlias = dict[str, str]


def is_survey_table(header: tuple[str, ...]) -> bool:
    """True if every column is known, one is a time, and something was measured."""
    columns = set(header)
    times, measured = columns & {SECONDS, UTC}, columns & set(QUANTITIES) - {"sigma_m"}
    return len(times) == 1 and bool(measured) and columns == times | (columns & set(QUANTITIES))


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
