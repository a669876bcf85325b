"""Counts against rectangles that are known, moves against a grid made anew, memory and work."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aquaflow.config.service import CoverageConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.survey.coverage import sub_map_coverage
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.coverage.footprint import BLOCKS, Footprint
from aquaflow.survey.coverage.plan import CoverageLayer, CoveragePlan, plan_of
from aquaflow.survey.coverage.raster import TILE_BYTES, cells_seen
from aquaflow.survey.coverage.sub_map_coverage import REDRAWN, SubMapCoverage
from tests.survey.coverage.surveys import (  # fmt: skip
    ALTITUDE,
    CAMERA,
    HEIGHT,
    PAGE,
    WIDTH,
    above,
    even,
    lawnmower,
    sides_at,
    surveyed,
    views_at,
)

CONFIG = CoverageConfig()


def shown(coverage: SubMapCoverage, limit: float | None = None) -> CoveragePlan:
    assert coverage.layer is not None
    plan = plan_of(coverage.layer, limit, CONFIG)
    assert plan is not None
    return plan


def centres(plan: CoveragePlan) -> np.ndarray:
    rows, columns = plan.classes.shape
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return np.dstack([x, y]) * plan.cell + plan.corner


def same(left: CoverageLayer, right: CoverageLayer) -> bool:
    a, b = left.tiles.tiles, right.tiles.tiles
    return a.keys() == b.keys() and all(
        np.array_equal(a[key].by_range, b[key].by_range)
        and np.array_equal(a[key].by_direction, b[key].by_direction)
        and a[key].keyframes == b[key].keyframes
        for key in a
    )


def test_each_cell_counts_the_views_whose_rectangle_holds_it() -> None:
    path = lawnmower(3, 6.0, 1.1, 0.45)
    plan = shown(surveyed(path))
    places, cell = centres(plan), plan.cell
    low, high = views_at(places, path, -0.75 * cell), views_at(places, path, 0.75 * cell)
    assert ((plan.views >= low) & (plan.views <= high)).all()
    inner = low == high
    assert inner.mean() > 0.3
    assert (plan.views[inner] == low[inner]).all()


def test_areas_are_those_of_the_rectangles() -> None:
    path = lawnmower(4, 8.0, 1.0, 0.45)
    plan = shown(surveyed(path))
    whole = (8.0 - 8.0 % 0.45 + HEIGHT) * (3 * 1.0 + WIDTH)
    area = sum(plan.area(seen) for seen in CoverageClass)
    assert area == pytest.approx(whole, rel=0.01)
    fine = np.dstack(np.meshgrid(np.arange(-1.3, 4.4, 0.05), np.arange(-1.0, 9.0, 0.05)))
    enough = views_at(fine, path) >= CONFIG.least_views
    well = (enough & (sides_at(fine, path) >= CONFIG.least_directions)).mean() * 5.7 * 10.0
    assert plan.area(CoverageClass.WELL) == pytest.approx(well, rel=0.03)


def test_one_pass_without_overlap_is_seen_sparsely_and_beyond_it_nothing() -> None:
    path = lawnmower(1, 9.0, 1.0, HEIGHT)
    plan = shown(surveyed(path))
    assert set(np.unique(plan.classes)) == {CoverageClass.NOT, CoverageClass.SPARSE}
    assert plan.classes_at(np.array([[0.0, 3.0], [0.0, 14.0], [WIDTH, 3.0]])).tolist() == [2, 0, 0]


def test_what_only_views_from_beyond_the_waters_range_show_is_too_far() -> None:
    coverage = surveyed(lawnmower(1, 4.0, 1.0, 0.4))
    near, far = shown(coverage, 1.4 * ALTITUDE), shown(coverage, 0.5 * ALTITUDE)
    assert near.area(CoverageClass.TOO_FAR) == 0.0
    assert near.area(CoverageClass.WELL) > 0.0
    assert {CoverageClass(each) for each in np.unique(far.classes)} == {
        CoverageClass.NOT,
        CoverageClass.TOO_FAR,
    }


def test_the_nearest_range_is_known_to_a_bin() -> None:
    coverage = SubMapCoverage(16, PAGE)
    for number, z in enumerate((2.0, 1.0, 1.5)):
        coverage.put(number, even(z), above(0.0, 0.0, z))
    coverage.settle()
    plan = shown(coverage)
    middle = plan.nearest[centres_are_near(plan, 0.2)]
    assert ((middle >= 1.0) & (middle <= 1.0 * 2**0.25 * 1.02)).all()


def centres_are_near(plan: CoveragePlan, radius: float) -> np.ndarray:
    return np.asarray(np.linalg.norm(centres(plan), axis=2) < radius)


def test_views_from_one_side_alone_are_one_direction() -> None:
    coverage = SubMapCoverage(16, PAGE)
    for number in range(5):
        coverage.put(number, even(), above(0.0, 0.01 * number))
    coverage.settle()
    plan = shown(coverage)
    directions = plan.directions[centres_are_near(plan, 0.2)]
    assert (directions == 1).all()
    assert (plan.classes[centres_are_near(plan, 0.2)] == CoverageClass.SPARSE).all()


MOVES = st.lists(
    st.tuples(
        st.integers(0, 11), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-0.6, 0.6),
        st.floats(0.8, 1.25),
    ),
    max_size=12,
)  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(MOVES, st.integers(1, 40))
def test_after_similarities_of_keyframes_the_counts_are_those_of_a_grid_made_anew(
    moves: list[tuple[int, float, float, float, float]], most: int
) -> None:
    path = lawnmower(2, 3.0, 1.0, 0.6)
    coverage = surveyed(path)
    for number, x, y, turn, scale in moves:
        before = coverage.seen[number][1]
        moved = Sim3(so3_exp(np.array([0.1 * turn, 0.0, turn])), np.array([x, y, 0.0]), scale)
        coverage.move({number: moved @ before})
        coverage.update(most)
    coverage.settle()
    assert coverage.layer is not None
    anew = CoverageLayer(coverage.layer.frame)
    for number, sight in coverage.seen.items():
        anew.draw(number, sight)
    assert same(coverage.layer, anew)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.1, 10.0))
@example(1.5)  # samples nearly as far apart as cells once lost a quarter of them
def test_another_unit_of_the_whole_map_changes_shares_by_no_more_than_the_cells_edges(
    scale: float,
) -> None:
    path = lawnmower(2, 4.0, 1.0, 0.45)
    coverage = surveyed(path)
    before = shown(coverage).area(CoverageClass.WELL)
    larger = Sim3(np.eye(3), np.zeros(3), scale)
    coverage.move({number: larger @ T for number, (_, T) in coverage.seen.items()})
    coverage.settle()
    assert shown(coverage).area(CoverageClass.WELL) == pytest.approx(scale**2 * before, rel=0.1)


def test_what_moves_by_less_than_a_fraction_of_a_cell_waits_for_the_end() -> None:
    coverage = surveyed(lawnmower(1, 4.0, 1.0, 0.5))
    nudge = Sim3(np.eye(3), np.array([0.002, 0.0, 0.0]))
    coverage.move({number: nudge @ T for number, (_, T) in coverage.seen.items()})
    assert coverage.settled
    assert coverage.update() == 0
    coverage.settle()
    assert coverage.layer is not None
    assert coverage.layer.drawn[0][1].t[0] == pytest.approx(0.002)


def test_a_turn_draws_no_more_than_its_share_and_what_moved_furthest_first() -> None:
    path = lawnmower(3, 12.0, 1.0, 0.5)
    coverage = surveyed(path)
    assert len(path) > 2 * REDRAWN
    coverage.move({
        number: Sim3(np.eye(3), np.array([0.3 + 0.01 * number, 0.0, 0.0])) @ T
        for number, (_, T) in coverage.seen.items()
    })  # fmt: skip
    assert coverage.update() == REDRAWN
    assert coverage.layer is not None
    shift = {n: T.t[0] - path[n, 0] for n, (_, T) in coverage.layer.drawn.items()}
    assert [n for n in sorted(shift) if shift[n] > 0.1] == list(range(len(path)))[-REDRAWN:]
    turns = 1
    while coverage.update():
        turns += 1
    assert turns == -(-len(path) // REDRAWN)


def test_while_the_grid_is_made_anew_the_one_of_before_is_shown_and_grows() -> None:
    path = lawnmower(3, 12.0, 1.0, 0.5)
    coverage = surveyed(path)
    before = coverage.layer
    coverage.turn(so3_exp(np.array([0.0, 0.0, 0.3])))
    coverage.put(len(path), even(), above(30.0, 0.0))
    coverage.update()
    assert coverage.layer is before
    assert before is not None
    assert len(path) in before.drawn
    while coverage.update():
        pass
    assert coverage.settled
    assert coverage.layer is not before
    plan, alone = shown(coverage), shown(surveyed(path))
    area, before = (sum(each.area(seen) for seen in CoverageClass) for each in (plan, alone))
    assert area == pytest.approx(before + WIDTH * HEIGHT, rel=0.02)


def test_a_long_dive_takes_larger_cells_and_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sub_map_coverage, "MOST_TILES", 180)
    coverage, largest = SubMapCoverage(16, PAGE), 0
    for number in range(300):
        coverage.put(number, even(), above(0.0, 0.9 * number))
        coverage.update()
        assert coverage.layer is not None
        largest = max(largest, coverage.layer.tiles.nbytes)
    while coverage.update():
        pass
    assert coverage.layer is not None
    assert coverage.layer.frame.cell > 1.9 * HEIGHT / 16
    assert largest <= 1.1 * 180 * TILE_BYTES
    area = sum(shown(coverage).area(seen) for seen in CoverageClass)
    assert area == pytest.approx(WIDTH * (299 * 0.9 + HEIGHT), rel=0.1)


def test_a_keyframe_that_goes_to_another_sub_map_leaves_nothing() -> None:
    coverage = surveyed(lawnmower(1, 2.0, 1.0, 1.0))
    for number in list(coverage.seen):
        coverage.take_out(number)
    coverage.update()
    assert coverage.layer is not None
    assert len(coverage.layer.tiles) == 0
    assert plan_of(coverage.layer, None, CONFIG) is None


def test_a_view_that_shows_nothing_or_has_no_pose_counts_nothing() -> None:
    coverage = SubMapCoverage(16, PAGE)
    coverage.put(0, even(0.0), above(0.0, 0.0))
    coverage.put(1, even(), above(np.nan, 0.0))
    assert coverage.update() == 0
    assert coverage.layer is None
    coverage.put(0, even(), above(0.0, 0.0))
    coverage.update()
    coverage.put(0, even(0.0), above(0.0, 0.0))
    coverage.update()
    assert coverage.layer is not None
    assert len(coverage.layer.tiles) == 0


def test_a_view_along_the_ground_draws_no_more_than_its_patches() -> None:
    along = Sim3(so3_exp(np.array([np.radians(-85.0), 0.0, 0.0])), np.array([0.0, 0.0, 1.0]))
    rows = np.linspace(1.0, 200.0, BLOCKS[0])[::-1, None]
    seen = Footprint(CAMERA, np.broadcast_to(rows, BLOCKS).astype(np.float16))
    coverage = surveyed(lawnmower(1, 1.0, 1.0, 1.0))
    assert coverage.layer is not None
    assert len(cells_seen(seen, along, coverage.layer.frame).ij) < BLOCKS[0] * BLOCKS[1] * 64
