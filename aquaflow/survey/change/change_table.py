"""``change.csv`` and ``change.json``: the patches as a table, and what all of it rests on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.table import csv_text
from aquaflow.survey.change.patches import NAMES, Patch
from aquaflow.survey.export.ortho.ground import Ground

Array = npt.NDArray[np.float64]

COLUMNS = (
    "number", "class", "x", "y", "height", "area", "volume", "volume_sigma", "distance",
    "distance_sigma", "brightness_ratio", "saturation_change", "chance", "partner", "moved_x",
    "moved_y", "moved_z", "moved", "moved_sigma",
)  # fmt: skip
DIGITS = 6


def row_of(number: int, patch: Patch, ground: Ground) -> dict[str, Any]:
    """A patch by column; None of what it does not have."""
    k, (x0, y0) = ground.grid_scale, ground.origin
    moved = patch.displacement
    values: tuple[Any, ...] = (
        number, NAMES[patch.kind], x0 + k * float(patch.place[0]), y0 + k * float(patch.place[1]),
        float(patch.place[2]), patch.area, patch.volume, patch.volume_sigma, patch.distance,
        patch.distance_sigma, math.exp(patch.lighter), patch.purer, patch.chance,
        None if patch.partner is None else patch.partner + 1,
        *((None,) * 3 if moved is None else moved),
        None if moved is None else float(np.linalg.norm(moved)), patch.displacement_sigma,
    )  # fmt: skip
    finite = (None if isinstance(v, float) and not math.isfinite(v) else v for v in values)
    row = dict(zip(COLUMNS, finite, strict=True))
    if row["volume"] is None:
        row["volume_sigma"] = None
    return row


def csv_of(rows: list[dict[str, Any]]) -> bytes:
    """The table with its head."""
    cells = ([_text(row[column]) for column in COLUMNS] for row in rows)
    return csv_text([COLUMNS, *cells]).encode("utf-8")


def _text(value: Any) -> str:
    if value is None:
        return ""
    # Coordinates on a UTM grid have seven digits before the point.
    return f"{value:.{DIGITS + 4}g}" if isinstance(value, float) else str(value)
