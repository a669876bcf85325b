"""Survey lines, overlap and the next line against paths whose lines are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.config.service import CoverageConfig
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.coverage.page_view import PageView, page_view
from aquaflow.survey.coverage.survey_lines import MOST_POINTS, LineState, line_state, survey_lines
from aquaflow.telemetry.world_frame import WorldFrame
from tests.survey.coverage.surveys import HEIGHT, WIDTH, lawnmower, metric, surveyed

CONFIG = CoverageConfig()
SWATH = 2.4


def nothing(places: np.ndarray) -> np.ndarray:
    return np.zeros(places.shape[:-1], bool)


def everything(places: np.ndarray) -> np.ndarray:
    return np.ones(places.shape[:-1], bool)


def state(path: np.ndarray, overlap: float = 0.6, covered: object = nothing) -> LineState:
    return line_state(survey_lines(path, SWATH), SWATH, overlap, covered)  # type: ignore[arg-type]


def viewed(
    path: np.ndarray, frame: WorldFrame | None = None, limit: float | None = None
) -> PageView:
    centres = np.column_stack([path, np.full(len(path), 2.0)])
    view = page_view(0, surveyed(path), centres, frame or metric(), limit, CONFIG)
    assert view is not None
    return view


@pytest.mark.parametrize("count", [1, 2, 5])
def test_each_line_of_a_survey_is_found_with_its_length(count: int) -> None:
    lines = survey_lines(lawnmower(count, 10.0, 1.0, 0.25), SWATH)
    assert len(lines) == count
    assert [line.length for line in lines] == pytest.approx([10.0] * count, abs=0.3)
    assert all(line.is_parallel(lines[0]) for line in lines)


def test_swaying_within_a_fraction_of_the_swath_is_still_one_line() -> None:
    y = np.arange(0.0, 20.0, 0.2)
    [line] = survey_lines(np.column_stack([0.08 * SWATH * np.sin(y), y]), SWATH)
    assert line.length == pytest.approx(20.0, abs=0.5)


def test_a_vehicle_that_circles_or_stays_swims_no_line() -> None:
    turn = np.linspace(0.0, 6 * np.pi, 400)
    circle = 1.5 * np.column_stack([np.cos(turn), np.sin(turn)])
    assert survey_lines(circle, SWATH) == []
    assert survey_lines(np.zeros((50, 2)), SWATH) == []
    assert survey_lines(np.zeros((0, 2)), SWATH) == []


def test_a_path_of_hours_is_looked_at_by_its_newest_points() -> None:
    path = lawnmower(40, 100.0, 1.0, 0.1)
    lines = survey_lines(path, SWATH)
    assert lines[-1].length == pytest.approx(100.0, abs=0.5)
    assert lines[0].first > len(path) - 4 * MOST_POINTS


@pytest.mark.parametrize(("spacing", "overlap"), [(0.96, 0.6), (1.8, 0.25), (3.0, -0.25)])
def test_the_overlap_is_that_of_the_swaths(spacing: float, overlap: float) -> None:
    assert state(lawnmower(3, 10.0, spacing, 0.25)).overlap == pytest.approx(overlap, abs=0.02)


def test_one_line_or_a_crossing_one_overlaps_nothing() -> None:
    assert state(lawnmower(1, 10.0, 1.0, 0.25)).overlap is None
    along, across = np.arange(0.0, 10.0, 0.25), np.arange(0.0, 8.0, 0.25)
    cross = np.concatenate([
        np.column_stack([np.zeros(len(along)), along]),
        np.column_stack([across, np.full(len(across), 10.0)]),
    ])  # fmt: skip
    assert state(cross).overlap is None


def test_a_line_of_another_survey_is_no_neighbour() -> None:
    found = state(lawnmower(2, 10.0, 6.0, 0.25))
    assert len(found.lines) >= 2
    assert found.overlap is None


def test_the_next_line_goes_on_at_the_wanted_spacing_from_where_the_vehicle_is() -> None:
    found = state(lawnmower(3, 10.0, 1.0, 0.25), overlap=0.5).suggestion
    assert found is not None
    assert found.start == pytest.approx(np.array([2.0 + 0.5 * SWATH, 10.0]), abs=0.3)
    assert found.end == pytest.approx(np.array([2.0 + 0.5 * SWATH, 0.0]), abs=0.3)


def test_the_next_line_turns_to_the_side_that_is_not_covered() -> None:
    path = lawnmower(2, 10.0, 1.0, 0.25)
    found = state(path, covered=lambda places: places[..., 0] > 0.5).suggestion
    assert found is not None
    assert found.start[0] < 1.0
    assert state(path, covered=everything).suggestion is None


def test_a_strip_that_was_missed_between_two_lines_is_next() -> None:
    path = lawnmower(2, 10.0, 4.0, 0.25)
    inner = np.abs(path[:, 1] % 10.0 - 5.0) < 6.0
    found = state(path[inner], covered=nothing).suggestion
    assert found is not None
    assert found.start[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("scale", "heading"), [(1.0, 0.0), (0.37, 0.5)])
def test_the_page_shows_lines_and_areas_in_the_dives_unit(scale: float, heading: float) -> None:
    path = lawnmower(3, 10.0, 0.96, 0.45)
    view = viewed(path, metric(scale, heading))
    assert view.unit == "m"
    assert view.state.swath == pytest.approx(scale * WIDTH, rel=0.01)
    assert view.state.overlap == pytest.approx(0.6, abs=0.02)
    assert [each.length for each in view.state.lines] == pytest.approx([scale * 9.9] * 3, rel=0.03)
    area = sum(view.area(seen) for seen in CoverageClass)
    assert area == pytest.approx(scale**2 * (9.9 + HEIGHT) * (1.92 + WIDTH), rel=0.01)


def test_places_of_the_page_have_the_class_of_the_cell_there() -> None:
    view = viewed(lawnmower(1, 6.0, 1.0, 0.45), metric(0.5, 0.7))
    on, off = view.path.mean(axis=0), view.path.mean(axis=0) + 3.0
    assert view.classes_at(np.array([on, off])).tolist() == [CoverageClass.WELL, CoverageClass.NOT]


def test_points_of_the_map_have_the_class_of_the_cell_below_them() -> None:
    plan = viewed(lawnmower(1, 6.0, 1.0, 0.45)).plan
    points = np.array([[0.0, 3.0, -0.4], [0.0, 3.0, 0.2], [5.0, 3.0, 0.0]])
    assert plan.classes_of(points).tolist() == [
        CoverageClass.WELL,
        CoverageClass.WELL,
        CoverageClass.NOT,
    ]


def test_without_gravity_the_page_is_in_map_units() -> None:
    unknown = replace(WorldFrame.unknown(), scale_source="none")
    view = viewed(lawnmower(2, 6.0, 1.0, 0.45), unknown)
    assert view.unit == "map units"
    assert view.state.swath > 0.0


def test_a_path_without_a_turn_is_a_line_before_one_between_turns_would_be() -> None:
    """Eight stills of an AUV are 1.2 to 1.5 swaths long, and a whole line."""
    ahead = np.column_stack([np.zeros(14), np.linspace(0.0, 1.25 * SWATH, 14)])
    assert survey_lines(ahead, SWATH) == []
    (line,) = survey_lines(ahead, SWATH, alone=0.75 * SWATH)
    assert line.length == pytest.approx(1.25 * SWATH, rel=0.1)
    assert survey_lines(ahead, SWATH, alone=1.3 * SWATH) == []
    aside = np.column_stack([np.linspace(0.0, 1.25 * SWATH, 14), np.full(14, ahead[-1, 1])])
    assert survey_lines(np.concatenate([ahead, aside]), SWATH, alone=0.75 * SWATH) == []
