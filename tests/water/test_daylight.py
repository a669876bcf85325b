"""Daylight that the water above the vehicle took colour from."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from aquaflow.config import MediumConfig
from aquaflow.config.white_balance import JERLOV_TYPES
from aquaflow.lab.synthetic.water import WATER_TYPES
from aquaflow.water.daylight import Depths, daylight_at, type_named, types_like
from tests.water.daylit import daylit_grey


def log_of(water: str, depth_m: float) -> np.ndarray:
    return daylight_at(type_named(water), Depths(depth_m, 0.0)).log


@pytest.mark.parametrize("depth_m", [3.0, 12.0, 30.0])
def test_the_colour_is_that_of_the_tables_light_through_a_cameras_channels(depth_m: float) -> None:
    expected = np.log(daylit_grey(depth_m))
    np.testing.assert_allclose(
        log_of("oceanic_II", depth_m), expected - expected.mean(), atol=0.003
    )


def test_at_the_surface_light_is_white_and_above_it_no_other() -> None:
    for water in JERLOV_TYPES:
        np.testing.assert_allclose(log_of(water, 0.0), 0.0, atol=1e-12)
        np.testing.assert_allclose(log_of(water, -0.3), 0.0, atol=1e-12)


def test_oceans_take_red_first_and_coasts_blue_as_well() -> None:
    red, green, blue = log_of("oceanic_I", 10.0)
    assert red < green < blue
    red, green, blue = log_of("coastal_7C", 10.0)
    assert blue < red < green


def test_deeper_and_more_varied_dives_are_less_sure() -> None:
    shallow, deep, varied = (
        daylight_at(type_named("oceanic_II"), depths)
        for depths in (Depths(3.0, 0.0), Depths(20.0, 0.0), Depths(20.0, 8.0))
    )
    assert (shallow.sigma[[0, 2]] < deep.sigma[[0, 2]]).all()
    assert (deep.sigma < varied.sigma).all()


def test_light_of_any_depth_is_finite() -> None:
    for water in JERLOV_TYPES:
        light = daylight_at(type_named(water), Depths(11_000.0, 10.0))
        assert np.isfinite([light.log, light.sigma]).all()
    for beta_a in (np.zeros(3), np.full(3, 100.0)):
        light = daylight_at(types_like(beta_a, 0.1), Depths(11_000.0, 10.0))
        assert np.isfinite([light.log, light.sigma]).all()


@pytest.mark.parametrize(
    "water", ["oceanic_IB", "oceanic_II", "coastal_1C", "coastal_3C", "coastal_5C"]
)
def test_the_waters_own_attenuation_tells_the_daylight_in_it(water: str) -> None:
    beta_a = np.array(WATER_TYPES[water].beta_a)
    types, depths = types_like(beta_a, 0.1), Depths(10.0, 0.0)
    true, found = daylight_at(type_named(water), depths), daylight_at(types, depths)
    assert (np.abs(found.log - true.log) < 2.0 * found.sigma).all()
    assert np.abs(found.log - true.log).max() < 0.2
    np.testing.assert_allclose(types_like(7.0 * beta_a, 0.1), types)


def test_an_attenuation_that_is_hardly_known_tells_little_of_the_daylight() -> None:
    beta_a = np.array(WATER_TYPES["oceanic_II"].beta_a)
    sure, unsure = (daylight_at(types_like(beta_a, s), Depths(10.0, 0.0)) for s in (0.1, 0.6))
    assert (sure.sigma < unsure.sigma).all()


def test_the_setting_is_any_case_and_a_wrong_one_names_the_types() -> None:
    assert MediumConfig(white_balance="DayLight:coastal_1c").white_balance == "daylight:coastal_1C"
    with pytest.raises(ValidationError, match=r"oceanic_I, oceanic_IA, .*coastal_9C"):
        MediumConfig(white_balance="daylight:2C")
    with pytest.raises(
        ValidationError, match="names no white balance; give camera, neutral, daylight, or day"
    ):
        MediumConfig(white_balance="1:3,4")
