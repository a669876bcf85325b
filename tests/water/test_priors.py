"""Weak priors on what the points look like without water, and their part in the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.config import WaterPriorsConfig
from aquaflow.water.beliefs import BRIGHT_LEVEL, DARK_LEVEL, beliefs
from aquaflow.water.fit import cost, normal_equations, weights
from aquaflow.water.model import Model, WaterModel
from tests.water.water_observations import B_RES, D, sighted

NOTHING = {"dark_channel": False, "saturation": False, "regions": False}
EACH = [
    WaterPriorsConfig(**{**NOTHING, name: True})
    for name in ("dark_channel", "saturation", "regions")
]


def colours(low: float, high: float) -> np.ndarray:
    """[3, 200] greys from dark to bright."""
    return np.tile(np.linspace(low, high, 200), (3, 1))


def test_an_ordinary_scene_is_believed_as_it_is() -> None:
    total = sum(b.residual**2 for b in beliefs(colours(0.0, 1.0), WaterPriorsConfig()))
    assert total < 0.01


def test_a_scene_without_shadows_is_doubted() -> None:
    found = beliefs(colours(0.4, 0.9), EACH[0])
    assert [b.residual for b in found] == pytest.approx([(0.409 - DARK_LEVEL) / 0.2] * 3, abs=0.05)


def test_a_scene_brighter_than_white_is_doubted_and_a_darker_one_is_not() -> None:
    assert beliefs(colours(0.0, 0.5 * BRIGHT_LEVEL), EACH[1]) == []
    assert all(b.residual > 1.0 for b in beliefs(colours(0.0, 1.5 * BRIGHT_LEVEL), EACH[1]))


@pytest.mark.parametrize("priors", EACH, ids=lambda p: str(p.model_dump()))
def test_every_prior_has_its_part_in_the_gradient(priors: WaterPriorsConfig) -> None:
    seen, model, noise = sighted(points=120), Model(water=True), 2.0  # so noisy that priors rule
    problem = WaterModel(seen, model, B_RES, D, priors)
    x = problem.start + 0.1 * np.arange(problem.size)
    x[:3] += 2.0  # water so thick that some points must be brighter than white
    now = problem.predict(x)
    no_black = np.maximum(now.J, 0.1) + 1e-3 * np.arange(seen.points)  # and none like another
    no_black = now.a * no_black[:, seen.point] + now.backscatter
    explained = replace(seen, colour=no_black.T)
    problem = WaterModel(explained, model, B_RES, D, priors)
    unbelieving = WaterModel(explained, model, B_RES, D, WaterPriorsConfig(**NOTHING))
    weight = weights(problem, problem.predict(x), noise)
    now = problem.predict(x, weight)
    assert cost(problem, x, now, noise) > cost(unbelieving, x, now, noise)
    _, gradient = normal_equations(problem, x, now, weight)
    for k in range(problem.size):
        step = 1e-5 * (np.arange(problem.size) == k)
        plus, minus = (
            cost(problem, moved, problem.predict(moved), noise) for moved in (x + step, x - step)
        )
        assert 2.0 * gradient[k] == pytest.approx((plus - minus) / 2e-5, rel=1e-3, abs=1e-3)
