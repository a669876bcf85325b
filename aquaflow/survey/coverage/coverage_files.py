"""The coverage of a finished dive: arrays for programs, numbers, and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.dive.metric_outputs import MetricOutputs
from aquaflow.dive.results import WaterSummary
from aquaflow.slam import Slam
from aquaflow.survey.coverage import DiveCoverage, PageView, Seen, mapping_range
from aquaflow.survey.coverage.coverage_file import NAME, write_coverage_file
from aquaflow.survey.coverage.picture import coverage_png

NUMBERS, PICTURE = "coverage.json", "coverage.png"
"""In the dive's folder, beside NAME."""


def final_views(
    coverage: DiveCoverage,
    slam: Slam,
    outputs: MetricOutputs,
    waters: Mapping[int, WaterSummary | None],
) -> dict[int, PageView]:
    """What is shown of each sub-map once all keyframes are where they stay."""
    coverage.look(slam.keyframes, outputs.frame, everything=True)
    coverage.settle()
    return current_views(coverage, slam, outputs, waters)


def current_views(
    coverage: DiveCoverage,
    slam: Slam,
    outputs: MetricOutputs,
    waters: Mapping[int, WaterSummary | None],
) -> dict[int, PageView]:
    """What is shown of each sub-map at the moment; ``waters`` in map units."""
    least = coverage.config.least_contrast
    limits = {
        number: None if water is None else mapping_range(water.beta_a, least)
        for number, water in waters.items()
    }
    return coverage.views(slam.keyframes, outputs.frame, limits)


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
