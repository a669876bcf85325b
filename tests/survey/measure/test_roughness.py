"""Rugosity, slope and relief of ground that is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.roughness import MATCH_SIGMA, chain_ratio, relief, slope, surface_ratio
from tests.survey.measure.fields import field

Array = npt.NDArray[np.float64]

RISE = 0.5
"""Tangent of the plane's slope."""


def plane(x: Array, y: Array) -> Array:
    return RISE * (0.6 * x + 0.8 * y)


def waves(x: Array, y: Array) -> Array:
    return 0.1 * np.sin(3.0 * x) * np.cos(2.0 * y)


def test_a_plane_has_the_numbers_of_a_plane() -> None:
    found = field(plane)
    assert surface_ratio(found).value == pytest.approx(np.sqrt(1.0 + RISE**2))
    along = [np.sqrt(1.0 + (part * RISE) ** 2) for part in (0.6, 0.8)]
    assert chain_ratio(found).value == pytest.approx(np.mean(along))
    for percent in (10.0, 50.0, 90.0):
        angle = slope(found, percent, 0.0)
        assert angle.value == pytest.approx(np.degrees(np.arctan(RISE)))
    low, high = np.percentile(found.height, (2.0, 98.0))
    assert relief(found, 0.0, 0.0, "m").value == pytest.approx(high - low)
    assert surface_ratio(found).sigma == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_what_noise_adds_is_taken_away_and_the_interval_holds(seed: int) -> None:
    sigma = 0.04
    noise = MATCH_SIGMA * sigma * np.random.default_rng(seed).standard_normal((60, 60))
    clean, noisy = field(waves, sigma=sigma), field(waves, sigma=sigma)
    noisy = replace(noisy, height=clean.height + noise, blurred=clean.height + noise)
    still = replace(clean, sigma=np.zeros((60, 60)))
    for statistic in (surface_ratio, chain_ratio):
        truth, plain = statistic(still).value, statistic(replace(noisy, sigma=still.sigma)).value
        found = statistic(noisy)
        assert plain - truth > 0.004
        assert abs(found.value - truth) < 0.25 * (plain - truth)
        assert found.low <= truth <= found.high
    steep = slope(noisy, 50.0, 0.0)
    assert steep.low <= slope(still, 50.0, 0.0).value <= steep.high


def test_what_the_resolution_took_once_is_estimated_by_taking_it_twice() -> None:
    soft = field(lambda x, y: 0.9 * waves(x, y), blurred=lambda x, y: 0.81 * waves(x, y))
    sharp = field(waves)
    for statistic in (surface_ratio, chain_ratio):
        found, truth = statistic(soft), statistic(sharp).value
        assert statistic(replace(soft, blurred=soft.height)).value < found.value < truth
        assert found.low <= truth <= found.high
    angle, flatter = slope(soft, 90.0, 0.0), relief(soft, 0.0, 0.0, "m")
    assert angle.low <= slope(sharp, 90.0, 0.0).value <= angle.high
    assert flatter.low <= relief(sharp, 0.0, 0.0, "m").value <= flatter.high


def test_a_tilt_that_is_not_known_widens_slope_and_relief() -> None:
    found = field(plane)
    exact, tilted = (slope(found, 50.0, tilt) for tilt in (0.0, 0.01))
    assert tilted.high - tilted.value == pytest.approx(1.96 * np.degrees(0.01), rel=1e-3)
    assert exact.high == exact.value
    assert relief(found, 0.01, 0.0, "m").sigma > 0.02
    by_scale = relief(found, 0.0, 0.01, "m")
    assert by_scale.sigma == pytest.approx(0.01 * by_scale.value)


def test_holes_leave_the_rest_as_it_is() -> None:
    found = field(plane)
    holed = found.height.copy()
    holed[10:20, 15:40] = np.nan
    assert surface_ratio(replace(found, height=holed, blurred=holed)).value == pytest.approx(
        np.sqrt(1.0 + RISE**2)
    )


@pytest.mark.parametrize("side", [0.1, 0.4])
def test_too_little_ground_is_refused(side: float) -> None:
    found = field(plane, side=side)
    for statistic in (surface_ratio, chain_ratio):
        with pytest.raises(InputError, match="fewer than 30 cells"):
            statistic(found)
    with pytest.raises(InputError, match="fewer than 30 cells"):
        slope(found, 50.0, 0.0)


def test_heights_between_cells_are_between_theirs_and_unknown_beside_holes() -> None:
    found = field(plane, sigma=0.02)
    places = np.array([[1.23, 2.34], [5.5, 0.5], [7.0, 1.0]])
    height, sigma = found.at(places)
    np.testing.assert_allclose(height[:2], plane(places[:2, 0], places[:2, 1]))
    np.testing.assert_allclose(sigma[:2], 0.02)
    assert np.isnan(height[2])
