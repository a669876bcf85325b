"""Light from beside the camera, apart from what the water takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from aquaflow.water.estimation import EVERY_MODEL, Model, WaterModel, with_lamp
from aquaflow.water.medium import WaterParameters
from aquaflow.water.model import Trial
from aquaflow.water.mounting import Lamp
from aquaflow.water.observations import Observations
from tests.water.water_observations import (
    B_RES,
    BETA,
    D,
    assert_derivatives_are_finite_differences,
    fitted,
    sighted,
)

Array = npt.NDArray[np.float64]

LAMP = Lamp(share=0.8, power=2.0, range=1.75)
GLOW = np.array([0.05, 0.04, 0.03])


def lit(daylight: Observations, seed: int = 1) -> Observations:
    """The same points by a lamp and little daylight."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(0.0, 0.9, (daylight.points, 1)) * rng.uniform(0.7, 1.0, (daylight.points, 3))
    trial = replace(still(), lamp=LAMP)
    seen = J[daylight.point] * trial.transmission(daylight.z) + GLOW
    seen += 0.005 * rng.normal(size=seen.shape)
    return replace(daylight, colour=seen)


def still() -> Trial:
    none = np.zeros(3)
    return Trial(BETA, none, none, np.zeros(5), np.zeros(5), np.zeros((4, 3)))


def test_by_a_lamp_attenuation_is_found_and_without_its_light_it_is_too_large() -> None:
    seen = lit(sighted(points=500))
    with_light = fitted(seen)
    assert with_light.lamp is not None
    error = np.abs(np.log(with_light.beta_a / BETA))
    assert (error < 0.15).all()
    assert with_light.beta_a_sigma is not None
    assert (error < 3.0 * np.array(with_light.beta_a_sigma)).all()
    np.testing.assert_allclose(with_light.glow, GLOW, atol=0.03)


def test_by_daylight_no_lamp_is_found() -> None:
    for seed in range(3):
        estimate = fitted(sighted(seed, points=500))
        assert estimate.lamp is None
        assert (estimate.glow == 0.0).all()


def test_the_maps_light_is_that_of_the_fit() -> None:
    z = np.array([0.01, 0.8, 1.75, 4.0])
    expected = replace(still(), lamp=LAMP).transmission(z)
    of = torch.tensor(BETA)
    water = WaterParameters(of, of, of, of, of, lamp=LAMP)
    np.testing.assert_allclose(water.transmission(torch.tensor(z)).numpy(), expected, rtol=1e-6)
    assert expected[1, 0] > np.exp(-BETA[0] * z[1])
    assert expected[3, 0] < np.exp(-BETA[0] * z[3])


def test_lamps_take_water_and_are_looked_for_in_even_backscatter() -> None:
    assert not Model(lamp=True).is_possible
    lit_models = with_lamp(EVERY_MODEL)
    assert lit_models
    assert all(model.lamp and model.water and not model.uneven for model in lit_models)


@pytest.mark.parametrize("c", range(3))
def test_derivatives_by_a_lamp_are_those_of_finite_differences(c: int) -> None:
    seen = lit(sighted(points=60))
    problem = WaterModel(seen, Model(water=True, shading=True, lamp=True), B_RES, D)
    assert_derivatives_are_finite_differences(problem, c, spread=0.1)
