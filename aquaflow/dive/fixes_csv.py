"""``fixes.csv``: where the dive lies at every position fix, less the fix; as surveyors check it.

Errors are of the body's origin, which fixes are of, at the moment that the fix is of, in the dive
that the sub-map's fit has placed. Fixes have no height.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.table import read_table, text_of_cell, text_of_number, write_table
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.telemetry.world_frame import FixErrors, Origin, WorldFrame

NAME = "fixes.csv"
SAME_MOMENT_S = 5e-4
"""Between a picture and the fix that was given for it; frames are further apart."""
DECIMALS = {"t_s": 9, "latitude_deg": 9, "longitude_deg": 9}
"""Nanoseconds; a tenth of a millimetre on the ground."""
OTHER_DECIMALS = 4


@dataclass(frozen=True)
class FixRow:
    """One line: a fix; its fields are the columns."""

    t_s: float
    """Seconds since the recording's first frame."""
    picture: str
    """The frame of that moment, as ``source`` in frames.csv; empty where there is none."""
    source: str
    """Name of the source in metric.json."""
    sub_map: int
    """Number of the sub-map, as in frames.csv."""
    latitude_deg: float
    longitude_deg: float
    """The fix, WGS 84."""
    sigma_m: float
    """1 sigma of each horizontal direction, as stated."""
    error_east_m: float
    error_north_m: float
    """The body in the dive less the fix."""
    error_m: float
    """Horizontal distance."""
    error_sigmas: float
    """Root mean square of the two directions over ``sigma_m``: 1 where fixes are as good as they
    say."""
    rejected: bool
    """``true`` if it contradicted the fixes around it, and took no part."""

    def cells(self) -> list[str]:
        """The row as text."""
        return [_text(field.name, getattr(self, field.name)) for field in fields(self)]


COLUMNS = tuple(field.name for field in fields(FixRow))


def _text(name: str, value: float | str | bool) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return text_of_number(value, DECIMALS.get(name, OTHER_DECIMALS))
    return str(value)


def fix_rows(frames: Mapping[int, WorldFrame], pictures: Sequence[FrameRow]) -> list[FixRow]:
    """The rows of all sub-maps, in the order of time; ``pictures``: the rows of frames.csv."""
    rows = [
        row
        for sub_map, frame in frames.items()
        for errors in frame.fixes
        if frame.origin is not None
        for row in _rows(errors, sub_map, frame.origin, _pictures_at(errors.t_s, pictures))
    ]
    return sorted(rows, key=lambda row: row.t_s)


def _rows(
    errors: FixErrors, sub_map: int, origin: Origin, pictures: Sequence[str]
) -> Iterator[FixRow]:
    level = np.column_stack([errors.fixes_n, np.zeros(len(errors.t_s))])
    places = latitude_longitude(level, (origin.latitude_deg, origin.longitude_deg))
    columns = (
        *places, errors.sigma_m, errors.errors_n[:, 1], errors.errors_n[:, 0], errors.errors_m,
        errors.in_sigmas,
    )  # fmt: skip
    for t_s, picture, numbers, rejected in zip(
        errors.t_s.tolist(), pictures, np.column_stack(columns).tolist(),
        errors.rejected.tolist(), strict=True,
    ):  # fmt: skip
        latitude, longitude, sigma, east, north, size, sigmas = numbers
        yield FixRow(
            t_s, picture, errors.source, sub_map, latitude, longitude, sigma, east, north, size,
            sigmas, rejected,
        )  # fmt: skip


def _pictures_at(
    t_s: npt.NDArray[np.float64],  # [N]
    pictures: Sequence[FrameRow],
) -> list[str]:
    """[N] names of the frames of these moments, empty where there is none."""
    if not pictures:
        return [""] * len(t_s)
    times = np.array([row.t_s for row in pictures])
    order = np.argsort(times, kind="stable")
    after = np.clip(np.searchsorted(times[order], t_s - SAME_MOMENT_S), 0, len(times) - 1)
    found = order[after]
    return [
        pictures[row].source if abs(times[row] - moment) <= SAME_MOMENT_S else ""
        for row, moment in zip(found.tolist(), t_s.tolist(), strict=True)
    ]


def fix_numbers(frames: Mapping[int, WorldFrame]) -> dict[str, Any] | None:
    """The key ``fixes`` of metrics.json; None where no fix has placed the dive."""
    every = [errors for frame in frames.values() for errors in frame.fixes]
    if not every:
        return None
    rejected = np.concatenate([errors.rejected for errors in every])
    metres = np.concatenate([errors.errors_m for errors in every])[~rejected]
    sigmas = np.concatenate([errors.in_sigmas for errors in every])[~rejected]
    known = len(metres) > 0
    return {
        "count": len(rejected),
        "rejected": int(rejected.sum()),
        "rms_m": float(np.sqrt(np.mean(metres**2))) if known else None,
        "largest_m": float(metres.max()) if known else None,
        "rms_sigmas": float(np.sqrt(np.mean(sigmas**2))) if known else None,
    }


def write_fixes_csv(path: Path, rows: Sequence[FixRow]) -> None:
    """Write the rows, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    write_table(path, [COLUMNS, *(row.cells() for row in rows)])


def read_fixes_csv(path: Path) -> list[FixRow]:
    """The rows of :func:`write_fixes_csv`.

    Raises:
        InputError: it cannot be read, or holds what is no such row.
    """
    return read_table(path, COLUMNS, _row)


def _row(cells: dict[str, str]) -> FixRow:
    texts = ("picture", "source", "sub_map", "rejected")
    numbers = {name: float(cells[name]) for name in COLUMNS if name not in texts}
    return FixRow(
        picture=text_of_cell(cells["picture"]), source=text_of_cell(cells["source"]),
        sub_map=int(cells["sub_map"]), rejected=cells["rejected"] == "true", **numbers,
    )  # fmt: skip
