"""The coverage of a finished dive: arrays for programs, numbers, and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.survey.coverage import PageView, Seen
from aquaflow.survey.coverage.coverage_file import NAME, write_coverage_file
from aquaflow.survey.coverage.picture import coverage_png

NUMBERS, PICTURE = "coverage.json", "coverage.png"
"""In the dive's folder, beside NAME."""


def write_coverage(dive: Path, views: Mapping[int, PageView], main: int) -> None:
    """coverage.npz, coverage.json and, of the ``main`` sub-map, coverage.png, into the folder of a
    dive; without views none.

    Raises:
        InputError: a file cannot be written.
    """
    if not views:
        return
    write_coverage_file(dive / NAME, views)
    write_json(dive / NUMBERS, {str(number): numbers(view) for number, view in views.items()})
    if main in views:
        with atomic_write(dive / PICTURE) as stream:
            stream.write(coverage_png(views[main]))


def numbers(view: PageView) -> dict[str, Any]:
    """Of one sub-map, in the unit of its metric frame."""
    state, limit = view.state, view.plan.limit
    return {
        "unit": view.unit,
        "area": {seen.name.lower(): view.area(seen) for seen in Seen if seen is not Seen.NOT},
        "cell": view.plan.frame.cell * view.scale,
        "range_limit": None if limit is None else limit * view.scale,
        "swath": state.swath,
        "lines": [
            {"start": line.start.tolist(), "end": line.end.tolist(), "length": line.length}
            for line in state.lines
        ],
        "overlap": state.overlap,
        "right": view.right,
        "up": view.up,
    }
