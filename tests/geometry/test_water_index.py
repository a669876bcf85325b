"""The refractive index of water against published values."""

from __future__ import annotations

import pytest

from aquaflow.geometry.port import FRESH_WATER, SEA_WATER, water_index


@pytest.mark.parametrize(
    ("salinity", "temperature", "wavelength", "published"),
    [
        # Austin and Halikas (1976), at atmospheric pressure.
        (0.0, 20.0, 589.3, 1.33299),
        (35.0, 20.0, 589.3, 1.33946),
    ],
)
def test_the_index_at_the_surface_is_the_measured_one(
    salinity: float, temperature: float, wavelength: float, published: float
) -> None:
    found = water_index(salinity, temperature, 0.0, wavelength)
    assert found == pytest.approx(published, abs=2e-4)


def test_pressure_raises_the_index_by_a_hundredth_in_seven_kilometres() -> None:
    # Austin and Halikas: 0.0155 for fresh water at 0 degrees C and 1080 bar.
    assert water_index(depth_m=1000.0) - water_index() == pytest.approx(0.00147, rel=0.1)


def test_the_defaults_are_sea_and_fresh_water_of_ten_degrees() -> None:
    assert water_index(35.0, 10.0) == SEA_WATER
    assert water_index(0.0, 10.0) == FRESH_WATER
    assert pytest.approx(0.0066, abs=2e-4) == SEA_WATER - FRESH_WATER


def test_warm_water_bends_light_less_than_cold() -> None:
    assert water_index(temperature_c=25.0) < water_index(temperature_c=2.0)
