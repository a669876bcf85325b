"""What sightings should look like, and how that changes with every parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.config import WaterPriorsConfig
from aquaflow.water.fit import normal_equations
from aquaflow.water.model import EXPOSURE_SIGMA, TERMS, Model, WaterModel
from aquaflow.water.observations import Observations
from tests.water.water_observations import B_RES, D

POINTS, SIGHTINGS, VIEWS = 40, 4, 5
NOTHING = WaterPriorsConfig(dark_channel=False, saturation=False, regions=False)


def scattered(seed: int = 0) -> Observations:
    """Points of any colour in any place, each in some of the views."""
    rng = np.random.default_rng(seed)
    view = np.concatenate([rng.permutation(VIEWS)[:SIGHTINGS] for _ in range(POINTS)])
    count = len(view)
    return Observations(
        np.repeat(np.arange(POINTS), SIGHTINGS),
        view,
        rng.uniform(0.3, 0.9, (count, 3)),
        rng.uniform(0.5, 3.0, count),
        rng.uniform(-0.9, 0.9, (count, 2)),
        rng.uniform(-1.0, 1.0, (POINTS, 3)),
    )


def exact(model: Model, error: float = 0.0) -> tuple[WaterModel, np.ndarray]:
    """A model, and parameters that explain its sightings but for a random error."""
    seen = scattered()
    problem = WaterModel(seen, model, B_RES, D)
    x = problem.start + np.random.default_rng(1).normal(0.0, 0.2, problem.size)
    off = np.random.default_rng(2).normal(0.0, error, seen.colour.shape)
    explained = seen.colour + problem.predict(x).errors.T + off
    return WaterModel(replace(seen, colour=explained), model, B_RES, D), x


EVERY = [
    Model(water=True),
    Model(shading=True),
    Model(exposure=True),
    Model(water=True, uneven=True),
    Model(water=True, shading=True, exposure=True),
]


@pytest.mark.parametrize("model", EVERY)
@pytest.mark.parametrize("channel", [0, 2])
def test_derivatives_are_those_of_the_errors_and_of_the_points(model: Model, channel: int) -> None:
    problem, x = exact(model)
    weight = np.random.default_rng(3).uniform(0.5, 2.0, (3, len(problem.seen.z)))
    now = problem.predict(x, weight)
    found = problem.derivatives(now, weight[channel], channel)
    for row, k in enumerate(found.own):
        step = 1e-6 * (np.arange(problem.size) == k)
        plus, minus = problem.predict(x + step, weight), problem.predict(x - step, weight)
        by_J = (plus.J - minus.J)[channel] / 2e-6
        np.testing.assert_allclose(found.by_J[row], by_J, atol=1e-6)
        if row < len(found.direct):
            whole = found.direct[row] + now.a[channel] * by_J[problem.seen.point]
            change = (plus.errors - minus.errors)[channel] / 2e-6
            np.testing.assert_allclose(whole, change, atol=1e-6)


@pytest.mark.parametrize("model", EVERY)
def test_the_normal_equations_are_those_of_all_derivatives_by_hand(model: Model) -> None:
    problem, x = exact(model, error=0.05)
    weight = np.random.default_rng(3).uniform(0.5, 2.0, (3, len(problem.seen.z)))
    now = problem.predict(x, weight)
    unbelieving = WaterModel(problem.seen, model, B_RES, D, NOTHING)
    H, g = normal_equations(unbelieving, x, now, weight)
    residuals, rows = problem.priors(x)
    H_hand, g_hand = rows.T @ rows, rows.T @ residuals
    for c in range(3):
        found = problem.derivatives(now, weight[c], c)
        views = np.eye(problem.views)[problem.seen.view].T
        of_gains = (views - views.mean(axis=0)) * found.lit if model.exposure else views[:0]
        whole = np.vstack([found.direct, of_gains]) + now.a[c] * found.by_J[:, problem.seen.point]
        H_hand[np.ix_(found.own, found.own)] += (weight[c] * whole) @ whole.T
        g_hand[found.own] += whole @ (weight[c] * now.errors[c])
    np.testing.assert_allclose(H, H_hand, atol=1e-6)
    np.testing.assert_allclose(g, g_hand, atol=1e-6)


def test_channels_share_the_shading_alone() -> None:
    problem, _ = exact(EVERY[-1])
    red, blue = set(problem.of_channel(0)), set(problem.of_channel(2))
    assert len(red & blue) == TERMS
    assert len(red) == 3 + TERMS + VIEWS


def test_exposures_are_expected_to_differ_by_as_much_as_they_do() -> None:
    problem, x = exact(Model(exposure=True))
    for size, bounds in ((0.0, EXPOSURE_SIGMA[0]), (0.2, 0.2), (9.0, EXPOSURE_SIGMA[1])):
        gains = size * np.resize([1.0, -1.0], VIEWS)
        residuals, _ = problem.expecting(np.repeat(gains, 3)).priors(np.repeat(np.eye(VIEWS)[0], 3))
        assert 1.0 / np.linalg.norm(residuals) == pytest.approx(bounds, rel=0.05)
    assert WaterModel(problem.seen, Model(), B_RES, D).expecting(x[:0]).size == 0


def test_a_lens_may_darken_the_edge_of_its_picture_but_hardly_brighten_it() -> None:
    problem, _ = exact(Model(shading=True))
    for term in (2, 4):  # x^2, y^2
        edge = 0.3 * (np.arange(problem.size) == problem.shading.start + term)
        darker, brighter = (np.linalg.norm(problem.priors(sign * edge)[0]) for sign in (-1, 1))
        assert darker == pytest.approx(1.0)
        assert brighter == pytest.approx(15.0)


def test_the_priors_derivatives_are_those_of_the_priors() -> None:
    problem, x = exact(EVERY[-1])
    _, rows = problem.priors(x)
    for k in range(problem.size):
        step = 1e-4 * (np.arange(problem.size) == k)
        change = (problem.priors(x + step)[0] - problem.priors(x - step)[0]) / 2e-4
        np.testing.assert_allclose(rows[:, k], change, atol=1e-8)


def test_brighter_views_and_brighter_points_are_not_told_apart() -> None:
    problem, x = exact(Model(exposure=True))
    np.testing.assert_allclose(problem.trial(x).exposure.mean(axis=0), 0.0, atol=1e-12)
    brighter = problem.predict(x + 0.3)
    np.testing.assert_allclose(brighter.errors, problem.predict(x).errors, atol=1e-9)


def test_a_fit_hands_on_the_parameters_that_both_models_have() -> None:
    simple = WaterModel(scattered(), Model(water=True), B_RES, D)
    x = simple.start + 0.1
    rich = WaterModel(simple.seen, EVERY[-1], B_RES, D)
    adopted = rich.predict(rich.adopt(simple, x))
    np.testing.assert_allclose(adopted.errors, simple.predict(x).errors, atol=1e-12)


@pytest.mark.parametrize("extreme", [-1e6, 1e6])
def test_extreme_parameters_give_finite_numbers(extreme: float) -> None:
    problem, x = exact(EVERY[-1])
    wild = np.full(len(x), extreme)
    wild[-1] = -extreme
    now = problem.predict(wild)
    found = problem.derivatives(now, np.ones(len(problem.seen.z)), 0)
    for values in (now.errors, now.J, found.direct, found.by_J):
        assert np.isfinite(values).all()


def test_no_point_is_darker_than_black() -> None:
    problem, x = exact(Model(water=True))
    black = replace(problem.seen, colour=np.zeros_like(problem.seen.colour))
    assert WaterModel(black, Model(water=True), B_RES, D).predict(x).J.min() == 0.0


def test_a_weighed_down_outlier_hardly_moves_its_point() -> None:
    problem, x = exact(Model(water=True))
    colour = problem.seen.colour.copy()
    colour[0] += 0.5
    outlying = WaterModel(replace(problem.seen, colour=colour), Model(water=True), B_RES, D)
    weight = np.ones((3, len(colour)))
    weight[:, 0] = 1e-6
    J = problem.predict(x).J[:, 0]
    np.testing.assert_allclose(outlying.predict(x, weight).J[:, 0], J, atol=1e-4)
    assert np.abs(outlying.predict(x).J[:, 0] - J).min() > 0.01
