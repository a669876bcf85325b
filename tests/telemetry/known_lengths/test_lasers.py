"""Two laser dots of known spacing: found, paired by their beams, measured, else refused."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.known_lengths.board_size import BoardView
from aquaflow.telemetry.known_lengths.finder import find_dots
from aquaflow.telemetry.known_lengths.known_length import scale_of
from tests.telemetry.known_lengths.laser_scenes import (
    CAMERA,
    HEIGHTS,
    METRES_PER_UNIT,
    Colour,
    Swim,
    dotted,
)


@pytest.mark.parametrize("colour", ["red", "green", "blue"])
def test_dots_are_found_to_a_fraction_of_a_pixel(colour: Colour) -> None:
    true = np.array([[200.3, 301.8], [420.6, 288.1]])
    found = find_dots(0, dotted(true, colour), colour).pixels
    assert found.shape == (2, 2)
    assert np.abs(found[np.argsort(found[:, 0])] - true).max() < 0.3


def test_what_is_of_another_colour_dim_large_or_long_is_no_dot() -> None:
    assert len(find_dots(0, dotted(np.array([[200.0, 300.0]]), "red"), "green").pixels) == 0
    assert len(find_dots(0, dotted(np.empty((0, 2))), "green").pixels) == 0
    weed = dotted(np.empty((0, 2)))
    weed[100:104, 100:300] = (20, 250, 30)
    weed[200:260, 200:260] = (20, 250, 30)
    weed[300:306, 300:306] = (20, 150, 30)
    assert len(find_dots(0, weed, "green").pixels) == 0


def test_the_dots_of_a_dive_give_the_metres_of_a_map_unit() -> None:
    lengths = Swim(HEIGHTS).lengths()
    assert [length.frame_index for length in lengths] == list(range(8))
    errors = [np.log(each.metres_per_unit / METRES_PER_UNIT) for each in lengths]
    assert np.abs(errors).max() < 0.05
    assert all(
        abs(error) < 3.5 * each.relative_sigma for error, each in zip(errors, lengths, strict=True)
    )
    scale = scale_of(lengths)
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.02)


def test_spots_of_the_same_colour_do_not_take_the_place_of_the_dots() -> None:
    rng = np.random.default_rng(9)
    swim = Swim(HEIGHTS)
    weed = rng.uniform([40, 40], [600, 200], (len(HEIGHTS), 4, 2))
    plain, among = swim.lengths(), swim.lengths(weed)
    assert [each.frame_index for each in among] == [each.frame_index for each in plain]
    for a, b in zip(plain, among, strict=True):
        assert a.metres_per_unit == pytest.approx(b.metres_per_unit, rel=0.01)


def test_dirt_on_the_window_is_no_beam() -> None:
    swim = Swim(HEIGHTS)
    swim.dots = [np.array([[250.0, 300.0], [380.0, 310.0]]) for _ in HEIGHTS]
    assert swim.lengths() == []


def test_dirt_is_no_beam_where_the_height_hardly_changes_either() -> None:
    swim = Swim(np.linspace(1.0, 1.2, 8), depth_sigma=0.02)
    swim.dots = [np.array([[250.0, 300.0], [380.0, 310.0]]) for _ in range(8)]
    assert swim.lengths() == []


def test_pictures_from_one_height_do_not_show_where_the_beams_are() -> None:
    assert Swim(np.full(8, 1.0)).lengths() == []


def test_spots_that_wander_are_no_beams() -> None:
    rng = np.random.default_rng(4)
    swim = Swim(HEIGHTS)
    swim.dots = [rng.uniform([60, 60], [580, 420], (2, 2)) for _ in HEIGHTS]
    assert swim.lengths() == []


def test_too_few_pictures_or_no_depth_give_no_length() -> None:
    assert Swim(HEIGHTS[:4]).lengths() == []
    blind = Swim(HEIGHTS)
    blind.views = [BoardView(CAMERA, Sim3.identity(), 0) for _ in HEIGHTS]
    assert blind.lengths() == []


def test_beams_that_may_lean_make_a_far_picture_less_certain() -> None:
    near, *_, far = Swim(HEIGHTS).lengths()
    assert far.sigma_m > 1.5 * near.sigma_m
