"""What sightings should look like, and how that changes with every parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.mapping.water.grouping import mean_by
from aquaflow.mapping.water.model import WaterModel
from aquaflow.mapping.water.observations import Observations
from aquaflow.mapping.water.parameters import MAX_LOG_RATE, Model
from aquaflow.mapping.water.shading import TERMS
from tests.mapping.water.water_observations import B_RES, D

POINTS, SIGHTINGS, VIEWS = 40, 6, 5


def scattered(seed: int = 0) -> Observations:
    """Points of any colour in any place, each in six pictures out of five views."""
    rng = np.random.default_rng(seed)
    count = POINTS * SIGHTINGS
    return Observations(
        np.repeat(np.arange(POINTS), SIGHTINGS),
        rng.integers(0, VIEWS, count),
        rng.uniform(0.3, 0.9, (count, 3)),
        rng.uniform(0.5, 3.0, count),
        rng.uniform(-0.9, 0.9, (count, 2)),
        rng.normal(0.0, 0.03, (count, 3)),
        rng.uniform(-1.0, 1.0, (POINTS, 3)),
    )


def exact(model: Model) -> tuple[WaterModel, np.ndarray]:
    """A model, and parameters that explain its sightings but for what is drawn from J."""
    seen = scattered()
    problem = WaterModel(seen, model, B_RES, D)
    x = problem.start + np.random.default_rng(1).normal(0.0, 0.2, problem.size)
    for c in range(3):
        seen.colour[:, c] += problem.predict(x, c)[0]
    return problem, x


EVERY = [
    Model(water=True),
    Model(shading=True),
    Model(exposure=True),
    Model(water=True, shading=True, exposure=True),
]


@pytest.mark.parametrize("model", EVERY)
@pytest.mark.parametrize("channel", [0, 2])
@pytest.mark.parametrize("error", [0.0, 0.1])
def test_derivatives_are_those_of_the_errors_and_of_the_points(
    model: Model, channel: int, error: float
) -> None:
    problem, x = exact(model)
    problem.seen.colour[:] += np.random.default_rng(2).normal(0.0, error, (len(problem.seen.z), 3))
    by_error, by_J = problem.derivatives(x, channel)
    for row, k in enumerate(problem.of_channel(channel)):
        step = 1e-6 * (np.arange(problem.size) == k)
        plus, minus = problem.predict(x + step, channel), problem.predict(x - step, channel)
        np.testing.assert_allclose(by_error[row], (plus[0] - minus[0]) / 2e-6, atol=1e-6)
        np.testing.assert_allclose(by_J[row], (plus[1] - minus[1]) / 2e-6, atol=1e-6)


def test_channels_share_the_shading_and_the_trust_in_neighbours() -> None:
    problem, _ = exact(EVERY[-1])
    red, blue = set(problem.of_channel(0)), set(problem.of_channel(2))
    assert len(red & blue) == TERMS + 2
    assert len(red) == 3 + TERMS + 2 + VIEWS


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
    views = np.arange(problem.size) >= problem.size - 3 * VIEWS
    brighter = problem.predict(x + 0.3 * views, 1)[0]
    np.testing.assert_allclose(brighter, problem.predict(x, 1)[0], atol=1e-9)


def test_a_fit_hands_on_the_parameters_that_both_models_have() -> None:
    simple = WaterModel(scattered(), Model(water=True), B_RES, D)
    x = simple.start + 0.1
    rich = WaterModel(simple.seen, EVERY[-1], B_RES, D)
    adopted = rich.adopt(simple, x)
    for c in range(3):
        np.testing.assert_allclose(rich.predict(adopted, c)[0], simple.predict(x, c)[0], atol=1e-12)


@pytest.mark.parametrize("extreme", [-1e6, 1e6])
def test_extreme_parameters_give_finite_numbers(extreme: float) -> None:
    problem, x = exact(EVERY[-1])
    wild = np.full(len(x), extreme)
    wild[-1] = -extreme
    for c in range(3):
        for values in (*problem.predict(wild, c), *problem.derivatives(wild, c)):
            assert np.isfinite(values).all()


def test_no_point_is_darker_than_black() -> None:
    problem, x = exact(Model(water=True))
    problem.seen.colour[:] = 0.0
    assert min(problem.predict(x, c)[1].min() for c in range(3)) == 0.0


@pytest.mark.parametrize("ranges", [(0.5, 3.0), (0.1, 1e3)])
def test_the_blend_fades_with_the_distance_from_the_points_mean_range(
    ranges: tuple[float, float],
) -> None:
    """As it looks there is known; what it is without water is not."""
    seen = scattered()
    z = np.where(np.arange(len(seen.z)) % 2, *ranges)
    seen = replace(seen, z=z, blend=np.full_like(seen.blend, 0.01))
    alone = WaterModel(replace(seen, blend=0.0 * seen.blend), Model(water=True), B_RES, D, 0.2)
    beside = WaterModel(seen, Model(water=True), B_RES, D, 0.2)
    x = beside.start.copy()
    x[0] = MAX_LOG_RATE if ranges[1] > 10.0 else np.log(0.2)
    changed, _ = beside.derivatives(x, 0)
    assert np.isfinite(changed).all()
    if ranges[1] < 10.0:
        x[:3], x[3:6] = np.log(0.2), np.log(0.2)
        seen.colour[:] += 1.0  # no point is black
        added = beside.predict(x, 0)[0] - alone.predict(x, 0)[0]
        own = 0.01 * np.exp(-0.2 * (z - mean_by(seen.point, z[:, None])[seen.point, 0]))
        T = np.exp(-0.2 * z)
        # The best J takes what of the blend looks like a brighter point.
        taken = np.bincount(seen.point, own * T) / np.bincount(seen.point, T * T)
        np.testing.assert_allclose(added, own - T * taken[seen.point], atol=1e-9)
