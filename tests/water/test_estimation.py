"""Water and shading from surface points seen at several ranges."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aquaflow.config import MediumConfig
from aquaflow.water.estimation import (
    CONTRAST_SIGMA,
    EVERY_MODEL,
    MIN_POINTS,
    WaterEstimate,
    estimating,
    models_for,
    without,
)
from aquaflow.water.fit import cost, descend
from aquaflow.water.model import TERMS, Model, WaterModel, shading_basis
from aquaflow.water.observations import Observations, run_to_end
from tests.water.water_observations import (
    B_INF,
    B_RES,
    BETA,
    LAMP,
    Array,
    B,
    D,
    estimate_water,
    fitted,
    sighted,
)


@cache
def plain() -> WaterEstimate:
    return fitted(sighted())


@cache
def shaded() -> WaterEstimate:
    return fitted(sighted(shading=LAMP))


@cache
def repeats() -> list[WaterEstimate]:
    """Small noisy fits that differ in nothing but their random numbers."""
    return [fitted(sighted(seed, points=140, sightings=3, noise=0.02)) for seed in range(6)]


@pytest.mark.parametrize("shading", [None, LAMP])
def test_the_water_is_found_to_a_tenth_with_and_without_shading(shading: Array | None) -> None:
    estimate = shaded() if shading is not None else plain()
    np.testing.assert_allclose(estimate.beta_a, BETA, rtol=0.1)
    np.testing.assert_allclose(estimate.B_inf, B_INF, rtol=0.1)
    # Red is gone before b shows: it leans on the prior that b and beta are alike.
    np.testing.assert_allclose(estimate.b, B, rtol=0.15)


def test_shading_is_rejected_where_there_is_none() -> None:
    assert not any(estimate.shading.any() for estimate in [plain(), *repeats()])


def test_shading_is_found_where_there_is_some() -> None:
    corners = np.array([[0.9, 0.9], [-0.9, 0.9], [0.9, -0.5], [-0.9, -0.9], [0.9, 0.0]])
    got = shading_basis(corners) @ shaded().shading
    np.testing.assert_allclose(got, shading_basis(corners) @ LAMP, atol=0.05)


def test_the_reported_sigma_is_the_scatter_of_repeats_within_a_factor_of_three() -> None:
    scatter = np.std([np.log(repeat.beta_a) for repeat in repeats()], axis=0, ddof=1)
    reported = np.mean([repeat.beta_a_sigma for repeat in repeats()], axis=0)
    unknown = CONTRAST_SIGMA / (1.75 * BETA)  # z is from 0.5 to 3
    assert (reported < 3.0 * np.hypot(scatter, unknown)).all()
    assert (reported > scatter / 3.0).all()


def test_a_fit_is_where_its_cost_is_least() -> None:
    """A fit that stops before its minimum passes for a poor model."""
    seen = sighted(sightings=5, shading=LAMP, log_gains=DIMMED, noise=0.02)
    problem = WaterModel(seen, Model(True, True, True), B_RES, D)
    fit = run_to_end(descend(problem, problem.start, 0.02))
    least = cost(fit.problem, fit.x, fit.prediction, fit.noise)
    deviations = np.sqrt(np.diag(fit.covariance))
    for k in range(problem.size):
        for side in (-0.3, 0.3):
            step = side * deviations[k] * (np.arange(problem.size) == k)
            moved = fit.problem.predict(fit.x + step, fit.weight)
            assert cost(fit.problem, fit.x + step, moved, fit.noise) > least - 0.1


def test_what_a_part_is_worth_follows_from_the_fit_that_has_it() -> None:
    """Savage and Dickey's ratio against the fit without the part."""
    seen = sighted(sightings=5, noise=0.02)
    rich, poor = (WaterModel(seen, Model(True, shading), B_RES, D) for shading in (True, False))
    fit = run_to_end(descend(rich, rich.start, 0.02))
    evidence, problem, x = without(fit, poor)
    alone = run_to_end(descend(poor, poor.start, 0.02))
    assert problem is poor
    assert evidence == pytest.approx(alone.log_evidence, abs=1.0)
    np.testing.assert_allclose(x, alone.x, atol=0.05)
    assert without(fit, rich)[0] == fit.log_evidence


def test_a_fit_pauses_every_few_steps() -> None:
    steps = estimating(sighted(), B_RES, D)
    assert sum(1 for _ in steps) > 10


def test_too_few_points_give_no_estimate() -> None:
    assert estimate_water(sighted(points=MIN_POINTS - 1), B_RES, D) is None


def test_no_sightings_at_all_give_no_estimate() -> None:
    number, colour = np.zeros(0, np.int64), np.zeros((0, 3))
    nothing = Observations(number, number, colour, np.zeros(0), np.zeros((0, 2)), colour)
    assert nothing.points == 0
    assert estimate_water(nothing, B_RES, D) is None


def test_sightings_without_noise_fit_perfectly_and_stay_finite() -> None:
    estimate = fitted(sighted(points=140, sightings=3, noise=0.0))
    np.testing.assert_allclose(estimate.beta_a, BETA, rtol=0.1)
    assert estimate.shading.shape == (TERMS,)
    assert np.isfinite(estimate.beta_a_sigma).all()


def test_black_pictures_give_finite_water() -> None:
    seen = sighted(points=140, sightings=3)
    black = replace(seen, colour=np.zeros_like(seen.colour))
    for models in (EVERY_MODEL, [Model(water=True)]):
        estimate = estimate_water(black, B_RES, D, models)
        assert estimate is not None
        for values in (estimate.beta_a, estimate.B_inf, estimate.b, estimate.exposure):
            assert np.isfinite(values).all()
        assert (estimate.B_inf * -np.expm1(-1.75 * estimate.b) < 0.06).all()


DIMMED = np.array([[0.0] * 3] * 3 + [[-0.6, -0.5, -0.4]] * 2)
"""Log-gains of five views: the lamps go down, and turn redder in doing so."""


@pytest.mark.parametrize("shading", [None, LAMP])
def test_light_that_changes_is_found_and_the_water_in_spite_of_it(shading: Array | None) -> None:
    estimate = fitted(sighted(sightings=5, shading=shading, log_gains=DIMMED))
    assert estimate.model == Model(water=True, shading=shading is not None, exposure=True)
    np.testing.assert_allclose(estimate.exposure, DIMMED - DIMMED.mean(axis=0), atol=0.05)
    np.testing.assert_allclose(estimate.beta_a, BETA, rtol=0.15)


def test_the_mean_exposure_is_one_whatever_the_light() -> None:
    estimate = fitted(sighted(sightings=5, log_gains=DIMMED + 0.3))
    np.testing.assert_allclose(estimate.exposure.mean(axis=0), 0.0, atol=1e-9)


def test_even_light_gets_no_exposures() -> None:
    assert not any(estimate.exposure.any() for estimate in [plain(), shaded(), *repeats()])


@pytest.mark.parametrize("shading", [None, LAMP])
@pytest.mark.parametrize("log_gains", [None, DIMMED])
def test_where_there_is_no_water_none_is_found(
    shading: Array | None, log_gains: Array | None
) -> None:
    seen = sighted(sightings=5, shading=shading, water=False, log_gains=log_gains)
    estimate = fitted(seen)
    assert not estimate.model.water
    assert estimate.evidence is not None
    assert estimate.evidence < 0.0
    assert estimate.beta_a_sigma is None
    assert not estimate.beta_a.any()
    assert not estimate.B_inf.any()


def test_the_evidence_speaks_for_water_where_there_is_some() -> None:
    evidence = [plain().evidence, shaded().evidence]
    assert all(value is not None and value > 10.0 for value in evidence)


def test_no_evidence_is_claimed_when_nothing_else_was_tried() -> None:
    seen = sighted(points=140, sightings=3)
    estimate = estimate_water(seen, B_RES, D, [Model(water=True)])
    assert estimate is not None
    assert estimate.evidence is None


def test_the_config_decides_what_may_be_found() -> None:
    assert models_for(MediumConfig()) == list(EVERY_MODEL)
    assert models_for(MediumConfig(enabled=False, shading=False)) == [
        Model(),
        Model(exposure=True),
    ]
    assert models_for(MediumConfig(off_when_clear=False, exposure=False, uneven=False)) == [
        Model(water=True),
        Model(water=True, shading=True),
    ]
