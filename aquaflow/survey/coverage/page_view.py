"""A sub-map's coverage as it is shown: on the page, in the unit of the dive, with its lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import CoverageConfig
from aquaflow.dive.placement import FROM_ABOVE, OFF_GROUND, names_of, page_axes
from aquaflow.survey.coverage.classes import COLOURS, CoverageClass
from aquaflow.survey.coverage.plan import CoveragePlan, plan_of
from aquaflow.survey.coverage.sub_map_coverage import SubMapCoverage
from aquaflow.survey.coverage.survey_lines import LineState, line_state, survey_lines
from aquaflow.survey.coverage.swath import MOST_SIGHTS, extent
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PageView:
    """Lengths and places are on the page, in ``unit``, right and up."""

    sub_map: int
    plan: CoveragePlan
    to_page: Array
    """[2, 3] affine map from the plan's frame to the page."""
    scale: float
    """Length of a map unit on the page."""
    unit: str
    seen: str
    right: str
    up: str
    """From where the page is seen, and what right and up on it are, in words."""
    path: Array
    """[N, 2] camera centres, in time."""
    state: LineState

    def area(self, seen: CoverageClass) -> float:
        """Area of a class, in the square of ``unit``."""
        return self.plan.area(seen) * self.scale**2

    @property
    def shares(self) -> dict[str, float]:
        """Of what was seen at all, on the page: each class by name."""
        counts = self.plan.cells
        whole = max(1, sum(counts.values()))
        return {seen.name.lower(): counts.get(seen, 0) / whole for seen in COLOURS}

    @property
    def areas(self) -> dict[str, float] | None:
        """m^2 of each class by name; None where the page is not the ground's or not in metres:
        there the ground has another size than on a chart."""
        if self.seen not in (FROM_ABOVE, OFF_GROUND) or self.unit != "m":
            return None
        return {seen.name.lower(): self.area(seen) for seen in COLOURS}

    def rescale(self, times: float, unit: str) -> PageView:
        """The same in another unit, of which one of before is ``times``."""
        state = self.state
        lines = [
            replace(each, start=times * each.start, end=times * each.end) for each in state.lines
        ]
        line = state.suggestion
        line = line and replace(line, start=times * line.start, end=times * line.end)
        return replace(
            self, to_page=times * self.to_page, scale=times * self.scale, unit=unit,
            path=times * self.path,
            state=LineState(lines, times * state.swath, state.overlap, line),
        )  # fmt: skip

    def classes_at(
        self,
        places: Array,  # [..., 2] on the page
    ) -> npt.NDArray[np.uint8]:
        """[...] the :class:`CoverageClass` there."""
        back = np.linalg.inv(self.to_page[:, :2])
        return self.plan.classes_at((places - self.to_page[:, 2]) @ back.T)


def page_view(
    sub_map: int,
    coverage: SubMapCoverage,
    centres: Array,  # [N, 3] of all keyframes in the sub-map's world, in time
    frame: WorldFrame,
    limit: float | None,
    config: CoverageConfig,
) -> PageView | None:
    """What is shown of a sub-map; None until anything was seen. ``limit``: range that the water
    allows, map units."""
    if coverage.layer is None:
        return None
    plan = plan_of(coverage.layer, limit, config)
    if plan is None or len(centres) == 0:
        return None
    centres_n = frame.T_nm.apply(centres)
    axes = page_axes(frame, centres_n)
    path, scale = centres_n @ axes.T, frame.T_nm.scale
    named = names_of(frame, axes)
    view = PageView(
        sub_map, plan, plan.page(frame.T_nm, axes), scale, frame.unit, *named, path,
        LineState([], 0.0, None, None),
    )  # fmt: skip
    state = _lines(view, coverage, axes @ frame.T_nm.R, config)
    return replace(view, state=state)


def _lines(
    view: PageView,
    coverage: SubMapCoverage,
    to_page: Array,  # [2, 3] directions of the page in the sub-map's world
    config: CoverageConfig,
) -> LineState:
    """Lines by the width of what is seen across the newest one; the only stretch of a path is one
    where its ends are further apart than a picture's shorter side."""

    def classify(
        places: Array,  # [..., 2] on the page
    ) -> npt.NDArray[np.bool_]:
        return np.asarray(view.classes_at(places) == CoverageClass.WELL)

    newest = [coverage.seen[number] for number in sorted(coverage.seen)[-MOST_SIGHTS:]]
    side = swath = view.scale * coverage.side
    lines = survey_lines(view.path, swath, alone=side)
    if lines:  # now it is known which way is across
        swath = view.scale * extent(newest, lines[-1].right @ to_page) or swath
        lines = survey_lines(view.path, swath, alone=side)
    return line_state(lines, swath, config.overlap, classify)
