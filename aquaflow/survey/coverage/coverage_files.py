"""The coverage of a finished dive: arrays for programs, numbers, and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.dive.deliverables import Deliverable
from aquaflow.dive.dive import Dive
from aquaflow.slam import Slam
from aquaflow.survey.coverage.coverage_file import NAME, write_coverage_file
from aquaflow.survey.coverage.dive_coverage import DiveCoverage
from aquaflow.survey.coverage.footprint import mapping_range
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.coverage.picture import coverage_png

NUMBERS, PICTURE = "coverage.json", "coverage.png"
"""In the dive's folder, beside NAME."""


class CoverageFiles(Deliverable):
    """coverage.npz, coverage.json and coverage.png: what the camera has seen."""

    stage = "writing the coverage"

    def __init__(self, slam: Slam) -> None:
        super().__init__(slam)
        config = slam.config.coverage
        self.coverage = DiveCoverage(config) if config.enabled else None
        """Of the running dive; any thread may look at it."""

    def look(self) -> None:
        """Take in new and moved keyframes."""
        if self.coverage is not None:
            with self.slam.profiler.stage("coverage"):
                self.coverage.look(self.slam.keyframes, self.slam.metric_frame)
                self.coverage.update()

    def refresh(self, dive: Dive) -> None:
        """Write the coverage as it is at the moment."""
        if self.coverage is not None:
            write_coverage(dive.path, self._views(self.coverage, dive), dive.main)

    def make(self, dive: Dive, until: Deadline) -> None:
        """Once all keyframes are where they stay."""
        if self.coverage is not None:
            self.coverage.look(self.slam.keyframes, dive.frame_of, everything=True)
            self.coverage.settle()
            self.refresh(dive)

    def _views(self, coverage: DiveCoverage, dive: Dive) -> dict[int, PageView]:
        least = coverage.config.least_contrast
        limits = {n: mapping_range(list(rates), least) for n, rates in dive.attenuations.items()}
        return coverage.views(self.slam.keyframes, dive.frame_of, limits)


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
    """Numbers of one sub-map, in the unit of its metric frame."""
    state, limit = view.state, view.plan.limit
    return {
        "unit": view.unit,
        "area": view.areas,
        "share": view.shares,
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
