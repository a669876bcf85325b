"""M3C2 on planes of known offset and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.survey.change.m3c2 import LEAST_POINTS, DayPoints, m3c2, normals_at
from tests.survey.change.clouds import SCALES, compared, cores, ground

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("of_surfaces", [False, True])
def test_an_offset_is_found_with_its_sign_and_along_the_normal(of_surfaces: bool) -> None:
    found = compared(ground(1, 0.005), ground(2, 0.005, 0.08), cores(), UP, of_surfaces=of_surfaces)
    assert found.seen.all()
    assert abs(found.distance.mean() - 0.08) < 0.0005
    assert found.distance.std() < 0.003
    np.testing.assert_array_less(0.999, found.normals[:, 2])


def test_the_level_of_detection_holds_what_it_says_where_nothing_changed() -> None:
    """Two clouds of the same plane: 95 % of the distances lie within the level."""
    inside = []
    for seed in range(6):
        found = compared(ground(2 * seed, 0.01), ground(2 * seed + 1, 0.01), cores(seed), UP)
        inside.append(np.abs(found.distance) <= found.level())
    share = float(np.mean(inside))
    assert 0.93 <= share <= 0.97  # 2400 draws, of which neighbours share some points


def test_few_points_have_a_wider_level_than_1_96_sigma() -> None:
    few = compared(ground(1, 0.01, count=2500), ground(2, 0.01, count=2500), cores(), UP)
    ratio = few.level() / few.sigma
    assert ratio[few.seen].min() > 1.99


def test_what_a_map_shares_is_not_divided_by_the_number_of_points() -> None:
    first, second = ground(1, 0.0), ground(2, 0.0)
    shared = replace(first, sigma=np.full(len(first.points), 0.03))
    found = compared(shared, second, cores(), UP)
    np.testing.assert_allclose(found.sigma, 0.03, rtol=1e-6)


def test_registration_widens_the_level_and_moves_nothing() -> None:
    first, second, places = ground(1, 0.005), ground(2, 0.005), cores()
    normals = np.tile(UP, (len(places), 1))
    plain = m3c2(first, second, places, normals, SCALES)
    wider = m3c2(first, second, places, normals, SCALES, np.full(len(places), 0.04))
    np.testing.assert_array_equal(plain.distance, wider.distance)
    np.testing.assert_allclose(wider.sigma, np.hypot(plain.sigma, 0.04))


def test_a_place_that_one_day_alone_shows_has_no_distance() -> None:
    first, second = ground(1, 0.005), ground(2, 0.005)
    half = DayPoints(
        second.points[second.points[:, 0] < 0.0], second.sigma[second.points[:, 0] < 0.0]
    )
    places = cores()
    found = compared(first, half, places, UP)
    assert found.seen[places[:, 0] < -0.1].all()
    assert not found.seen[places[:, 0] > 0.1].any()
    assert np.isnan(found.sigma[places[:, 0] > 0.1]).all()


def test_a_place_without_a_normal_has_no_distance() -> None:
    normals = np.full((1, 3), np.nan)
    assert not m3c2(ground(1, 0.0), ground(2, 0.0), np.zeros((1, 3)), normals, SCALES).seen.any()
    assert np.isnan(normals_at(np.full((1, 3), 9.0), np.zeros((5, 3)), np.ones((5, 3)), 0.1)).all()


def test_a_surface_that_is_still_there_counts_before_another_behind_it() -> None:
    """An overhang: the second day also shows what is 0.3 below."""
    below = ground(3, 0.002, -0.3, 20000)
    both = ground(2, 0.002)
    layers = DayPoints(np.vstack([both.points, below.points]), np.zeros(26000))
    nearest = compared(ground(1, 0.002), layers, cores(), UP, of_surfaces=True)
    assert np.abs(nearest.distance).max() < 0.01
    mixed = compared(ground(1, 0.002), layers, cores(), UP)
    assert mixed.distance.mean() < -0.1


def test_what_faces_elsewhere_is_another_surface() -> None:
    first, second = ground(1, 0.002), ground(2, 0.002, 0.1)
    up, down = np.tile(UP, (6000, 1)), np.tile(-UP, (6000, 1))
    seen = compared(replace(first, normals=up), replace(second, normals=up), cores(), UP)
    back = compared(replace(first, normals=up), replace(second, normals=down), cores(), UP)
    assert seen.seen.all()
    assert not back.seen.any()
    assert back.first.min() >= LEAST_POINTS


@settings(max_examples=10)
@given(
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shift=st.tuples(*[st.floats(-50.0, 50.0)] * 3),
)
def test_distances_do_not_change_when_both_clouds_move_together(
    turn: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    R, t = Rotation.from_rotvec(turn).as_matrix(), np.array(shift)
    first, second = ground(1, 0.01, count=2000), ground(2, 0.01, 0.05, 2000)
    places = cores(count=40)
    here = compared(first, second, places, UP)
    moved = [replace(each, points=each.points @ R.T + t) for each in (first, second)]
    there = compared(moved[0], moved[1], places @ R.T + t, R @ UP)
    # A point on a cylinder's rim may fall to the other side of it.
    close = np.isclose(here.distance, there.distance, atol=1e-9, equal_nan=True)
    assert close.mean() > 0.9
    np.testing.assert_allclose(here.distance, there.distance, atol=0.003)


def test_swapped_days_have_distances_of_the_other_sign() -> None:
    first, second, places = ground(1, 0.01), ground(2, 0.01, 0.05), cores()
    normals = np.tile(UP, (len(places), 1))
    one = m3c2(first, second, places, normals, SCALES)
    other = m3c2(second, first, places, normals, SCALES)
    np.testing.assert_allclose(one.distance, -other.distance)
    np.testing.assert_allclose(one.level(), other.level())


def test_distances_agree_with_py4dgeo_where_it_is_installed() -> None:
    py4dgeo = pytest.importorskip("py4dgeo", reason="py4dgeo has no wheel for every machine")
    first, second, places = ground(1, 0.01), ground(2, 0.01, 0.05), cores()
    epochs = (py4dgeo.Epoch(first.points), py4dgeo.Epoch(second.points))
    other = py4dgeo.M3C2(
        epochs=epochs, corepoints=places, cyl_radius=SCALES.cylinder,
        normal_radii=(SCALES.normal,), max_distance=SCALES.reach, registration_error=0.0,
    )  # fmt: skip
    theirs, uncertainty = other.run()
    found = compared(first, second, places, UP)
    side = np.sign(other.directions()[:, 2])
    np.testing.assert_allclose(found.distance, side * theirs, atol=1e-3)
    np.testing.assert_allclose(1.96 * found.sigma, uncertainty["lodetection"], rtol=0.05)
