"""``trajectory.csv``: every pose with time, depth, attitude and place on the earth, for surveyors.

What is unknown is an empty cell. Positions are those of ``trajectory.tum``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime, timezone
from pathlib import Path

from aquaflow.base.storage.table import read_table, text_of_number, write_table

NAME = "trajectory.csv"
DECIMALS = {"t_s": 9, "latitude_deg": 9, "longitude_deg": 9, "x": 6, "y": 6, "z": 6}
"""Nanoseconds; a tenth of a millimetre on the ground; micrometres."""
OTHER_DECIMALS = 4
"""Of depths and speeds: 0.1 mm; of angles: 0.4 mm at 200 m."""


@dataclass(frozen=True)
class PoseRow:
    """One line: a pose of the camera; its fields are the columns."""

    index: int
    """Position in the recording, as in frames.csv."""
    t_s: float
    """Seconds since the recording's first frame."""
    utc: datetime | None
    """ISO 8601 with microseconds."""
    sub_map: int
    """Number of the sub-map, as in frames.csv."""
    x: float
    y: float
    z: float
    """The camera's centre in n, as in trajectory.tum."""
    unit: str
    """Of x, y, z: ``m``, or ``map units`` where the sub-map's scale is unknown."""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    """Of the camera's centre, WGS 84; where an origin and true north are known."""
    depth_m: float | None = None
    altitude_m: float | None = None
    """Below the surface and above the bottom, as measured; linear between samples at most 2 s
    apart."""
    heading_deg: float | None = None
    """0 to 360, clockwise from what x points to; of the body, or the camera if its mounting is
    unknown; only where gravity is known."""
    roll_deg: float | None = None
    pitch_deg: float | None = None
    """Of the body or the camera, as the heading."""
    speed_m_s: float | None = None
    """Of the camera over 0.5 s, at least over the neighbouring poses; none across more than 5 s."""
    sigma_position_m: float | None = None
    """1 sigma in the direction that is known least, from the covariance of ``T_nm``."""
    sigma_heading_deg: float | None = None
    """1 sigma of the heading of n."""

    def cells(self) -> list[str]:
        """The row as text."""
        return [_text(field.name, getattr(self, field.name)) for field in fields(self)]


COLUMNS = tuple(field.name for field in fields(PoseRow))
_REQUIRED = ("t_s", "x", "y", "z")


def _text(name: str, value: int | float | str | datetime | None) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime):
        utc = value.astimezone(timezone.utc)
        return utc.replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"
    if isinstance(value, float):
        return text_of_number(value, DECIMALS.get(name, OTHER_DECIMALS))
    return str(value)


def write_trajectory_csv(path: Path, rows: Sequence[PoseRow]) -> None:
    """Write the rows, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    write_table(path, [COLUMNS, *(row.cells() for row in rows)])


def read_trajectory_csv(path: Path) -> list[PoseRow]:
    """The rows of :func:`write_trajectory_csv`.

    Raises:
        InputError: it cannot be read, or holds what is no such row.
    """
    return read_table(path, COLUMNS, _row)


def _row(cells: dict[str, str]) -> PoseRow:
    numbers = {
        name: float(cells[name]) if cells[name] or name in _REQUIRED else None
        for name in COLUMNS
        if name not in ("index", "utc", "sub_map", "unit")
    }
    utc = datetime.fromisoformat(cells["utc"].replace("Z", "+00:00")) if cells["utc"] else None
    return PoseRow(
        index=int(cells["index"]), utc=utc, sub_map=int(cells["sub_map"]), unit=cells["unit"],
        **numbers,  # type: ignore[arg-type]
    )  # fmt: skip
