"""Backscatter that is brighter on one side of the picture than on the other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from aquaflow.config import MediumConfig
from aquaflow.water.estimation import EVERY_MODEL, WaterEstimate, models_for
from aquaflow.water.model import TERMS, Model, shading_basis
from tests.water.water_observations import B_INF, BETA, LAMP, B, fitted, sighted

BRIGHTER_ABOVE = np.array([0.0, -0.7, 0.0, 0.0, 0.1])


@cache
def sunlit() -> WaterEstimate:
    """Water that shines upwards twice as brightly as downwards."""
    seen = sighted(points=600)
    veil = B_INF * -np.expm1(-B * seen.z[:, None])
    more = np.expm1(shading_basis(seen.xy) @ BRIGHTER_ABOVE)[:, None]
    return fitted(replace(seen, colour=seen.colour + more * veil))


def test_uneven_backscatter_is_found_and_the_water_in_spite_of_it() -> None:
    assert sunlit().model == Model(water=True, uneven=True)
    np.testing.assert_allclose(sunlit().beta_a, BETA, rtol=0.1)
    edge = shading_basis(np.array([[0.0, -0.8], [0.0, 0.8]]))
    np.testing.assert_allclose(edge @ sunlit().unevenness, edge @ BRIGHTER_ABOVE, atol=0.2)


def test_even_backscatter_and_a_lamp_are_not_taken_for_it() -> None:
    for estimate in (fitted(sighted()), fitted(sighted(shading=LAMP))):
        assert not estimate.model.uneven
        assert estimate.unevenness.tolist() == [0.0] * TERMS


def test_unevenness_takes_water() -> None:
    uneven = [model for model in EVERY_MODEL if model.uneven]
    assert len(uneven) == 4
    assert all(model.water for model in uneven)


def test_shading_and_unevenness_are_found_together_only_with_open_water_in_view() -> None:
    assert Model(True, shading=True, uneven=True).takes_open_water
    assert not fitted(sighted(shading=LAMP)).model.uneven


def test_the_config_forbids_it() -> None:
    assert not any(model.uneven for model in models_for(MediumConfig(uneven=False)))
