"""Water and shading from surface points seen at several ranges."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.mapping.shading import TERMS, shading_basis
from aquaflow.mapping.water_estimation import (
    MIN_POINTS,
    MIN_RANGE_RATIO,
    Observations,
    WaterEstimate,
    estimate_water,
    informative,
)

Array = npt.NDArray[np.float64]

BETA = np.array([0.6, 0.3, 0.2])
B_INF = np.array([0.1, 0.3, 0.4])
B = np.array([0.7, 0.35, 0.25])
B_RES, D = np.full(3, 0.01), np.ones(3)
LAMP = np.array([0.0, 0.1, -0.35, 0.0, -0.4])


def sighted(
    seed: int = 0,
    points: int = 300,
    sightings: int = 4,
    noise: float = 0.005,
    shading: Array | None = None,
) -> Observations:
    """Sightings of points whose colours span black to bright, through known water."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(0.0, 0.9, (points, 1)) * rng.uniform(0.7, 1.0, (points, 3))
    point = np.repeat(np.arange(points), sightings)
    z = rng.uniform(0.5, 3.0, len(point))
    xy = rng.uniform(-0.95, 0.95, (len(point), 2))
    # Near ground is seen near the lower edge: the case in which a lamp looks like water.
    xy[:, 1] = np.clip(0.95 - 0.5 * z + 0.4 * xy[:, 1], -0.95, 0.95)
    path = z[:, None]
    seen = (
        J[point] * np.exp(-BETA * path) + B_INF * -np.expm1(-B * path) + B_RES * np.exp(-D * path)
    )
    if shading is not None:
        seen = seen * np.exp(shading_basis(xy) @ shading)[:, None]
    return Observations(point, seen + noise * rng.normal(size=seen.shape), z, xy)


def fitted(seen: Observations) -> WaterEstimate:
    estimate = estimate_water(seen, B_RES, D, start_beta=0.1)
    assert estimate is not None
    return estimate


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
    assert (reported < 3.0 * scatter).all()
    assert (reported > scatter / 3.0).all()


def test_too_few_points_give_no_estimate() -> None:
    assert estimate_water(sighted(points=MIN_POINTS - 1), B_RES, D, 0.1) is None


def test_points_that_are_all_at_one_range_give_no_estimate() -> None:
    seen = sighted()
    flat = Observations(seen.point, seen.colour, np.full(len(seen.z), 1.5), seen.xy)
    assert informative(flat).points == 0
    assert estimate_water(flat, B_RES, D, 0.1) is None


def test_no_sightings_at_all_give_no_estimate() -> None:
    nothing = Observations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))
    assert nothing.points == 0
    assert estimate_water(nothing, B_RES, D, 0.1) is None


def test_only_points_seen_over_a_span_of_ranges_are_kept_and_renumbered() -> None:
    just, over = MIN_RANGE_RATIO, MIN_RANGE_RATIO + 0.01
    z = np.array([1.0, 1.0, 1.0, just, over, 2.0, 2.0 * over, 3.0])
    point = np.array([0, 1, 2, 0, 1, 3, 3, 4])
    kept = informative(Observations(point, np.arange(24.0).reshape(8, 3), z, np.zeros((8, 2))))
    assert kept.point.tolist() == [0, 0, 1, 1]
    assert kept.z.tolist() == [1.0, over, 2.0, 2.0 * over]
    assert kept.colour[:, 0].tolist() == [3.0, 12.0, 15.0, 18.0]


def test_sightings_without_noise_fit_perfectly_and_stay_finite() -> None:
    estimate = fitted(sighted(points=140, sightings=3, noise=0.0))
    np.testing.assert_allclose(estimate.beta_a, BETA, rtol=0.1)
    assert estimate.shading.shape == (TERMS,)
    assert np.isfinite(estimate.beta_a_sigma).all()


def test_black_pictures_give_finite_water() -> None:
    seen = sighted(points=140, sightings=3)
    black = Observations(seen.point, np.zeros_like(seen.colour), seen.z, seen.xy)
    estimate = fitted(black)
    for values in (estimate.beta_a, estimate.B_inf, estimate.b, estimate.beta_a_sigma):
        assert np.isfinite(values).all()
    assert (estimate.B_inf < 0.1).all()


def test_shading_stays_out_when_it_is_switched_off() -> None:
    seen = sighted(points=140, sightings=3, shading=LAMP)
    estimate = estimate_water(seen, B_RES, D, 0.1, shading=False)
    assert estimate is not None
    assert not estimate.shading.any()
