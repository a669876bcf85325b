"""Open water: smooth, and of the colour of water seen over any length."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.water.open_sightings import light_of_ground, open_water

B_INF = np.broadcast_to(np.float32([0.1, 0.3, 0.4]), (60, 80, 3))
MEAN = np.array([0.4, 0.5, 0.3])
NEAR = np.full((60, 80), 0.3, np.float32)
"""Light that ground there would return."""


def sea_floor_below(row: int) -> np.ndarray:
    """[60, 80, 3]: open water with a camera's noise, and below the row a floor with texture."""
    random = np.random.default_rng(0)
    image = B_INF + random.normal(0.0, 0.004, (60, 80, 3))
    image[row:] = random.uniform(0.1, 0.6, (60 - row, 80, 3))
    return image.astype(np.float32)


def test_open_water_is_found_and_the_floor_is_not() -> None:
    found = open_water(sea_floor_below(30), B_INF, NEAR)
    assert found[:24].all()
    assert not found[30:].any()


def test_water_that_is_brighter_on_one_side_is_open_as_a_whole() -> None:
    sunlit = sea_floor_below(30) * np.linspace(1.4, 0.9, 80, dtype=np.float32)[:, None]
    assert open_water(sunlit, B_INF, NEAR)[:24].all()


@pytest.mark.parametrize("colour", [(0.5, 0.45, 0.4), (0.02, 0.02, 0.02), (0.4, 0.3, 0.1)])
def test_smooth_ground_of_another_colour_is_not_open_water(colour: tuple[float, ...]) -> None:
    assert not open_water(np.full((60, 80, 3), colour, np.float32), B_INF, NEAR).any()


def test_a_small_smooth_spot_is_not_open_water() -> None:
    image = sea_floor_below(0)
    image[20:32, 30:42] = B_INF[0, 0]
    assert not open_water(image, B_INF, NEAR).any()


def test_a_picture_that_is_textured_all_over_has_none() -> None:
    assert not open_water(sea_floor_below(0), B_INF, NEAR).any()


@pytest.mark.parametrize("share", [0.05, 0.1, 0.3])
def test_far_ground_in_murky_water_is_none_however_little_of_its_texture_is_left(
    share: float,
) -> None:
    random = np.random.default_rng(0)
    J = MEAN * (1.0 + 0.3 * random.normal(size=(60, 80, 1)))
    T = np.full((60, 80, 3), share)
    image = (share * J + (1.0 - share) * B_INF).astype(np.float32)
    ground = light_of_ground(MEAN, T, np.ones((60, 80), bool))
    assert not open_water(image, B_INF, ground).any()


def test_what_is_smooth_where_no_range_is_known_is_open_water() -> None:
    ground = light_of_ground(MEAN, np.zeros((60, 80, 3)), np.zeros((60, 80), bool))
    found = open_water(sea_floor_below(30), B_INF, ground)
    assert found[:24].all()
    assert not found[30:].any()
