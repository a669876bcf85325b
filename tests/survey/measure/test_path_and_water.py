"""The length of the camera's way, and how far one sees."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.survey.measure.areas import way
from aquaflow.survey.measure.quantity import Scale
from aquaflow.survey.measure.reef_numbers import visibility

METRES = Scale("m", 0.01, 0.0)


def circle(count: int) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    return np.stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.1 * angle], axis=1)


def test_the_way_is_as_long_as_it_is_and_the_scale_says_how_well_that_is_known() -> None:
    found = way(circle(400), METRES)
    assert found is not None
    assert found.value == pytest.approx(2.0 * np.pi * np.hypot(3.0, 0.1), rel=1e-3)
    assert found.high - found.value == pytest.approx(1.96 * 0.01 * found.value, rel=1e-3)


@pytest.mark.parametrize("jitter", [0.002, 0.01, 0.03])
def test_what_jitter_adds_lies_within_the_interval(jitter: float) -> None:
    places = circle(400)
    noise = jitter * np.random.default_rng(2).standard_normal(places.shape)
    found, truth = way(places + noise, Scale("m", 0.0, 0.0)), way(places, METRES)
    assert found is not None
    assert truth is not None
    assert found.low <= truth.value < found.value
    assert found.value - found.low < 2.0 * (found.value - truth.value)


def test_a_single_pose_is_no_way() -> None:
    assert way(circle(400)[:1], METRES) is None


def test_one_sees_as_far_as_a_twentieth_of_the_contrast_in_the_clearest_colour() -> None:
    found = visibility([0.6, 0.25, 0.3], [0.05, 0.1, 0.1], METRES)
    assert found is not None
    assert np.exp(-0.25 * found.value) == pytest.approx(0.05)
    assert found.sigma / found.value == pytest.approx(np.hypot(0.1, 0.01))
    assert found.low * found.high == pytest.approx(found.value**2)
    assert found.unit == "m"


@pytest.mark.parametrize(
    ("rates", "sigmas"),
    [([0.6, 0.2, 0.3], None), ([0.0, 0.0, np.inf], [0.1] * 3), ([0.6] * 3, [np.inf] * 3)],
)
def test_water_that_was_not_measured_has_no_visibility(
    rates: list[float], sigmas: list[float] | None
) -> None:
    assert visibility(rates, sigmas, METRES) is None
