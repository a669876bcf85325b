"""Kernels against their definition, and spreads against the normal distribution."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.optimise.robust import (
    MAD_TO_SIGMA,
    MEDIAN_LENGTH,
    Cauchy,
    Huber,
    RobustKernel,
    SoftL1,
    Tukey,
    sigma_of,
    sigma_of_lengths,
)

KERNELS = [Huber(), Huber(2.0), Cauchy(2.4), SoftL1(), Tukey()]
SIZES = np.geomspace(1e-3, 1e3, 500)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_weight_is_the_costs_derivative_over_the_size(kernel: RobustKernel) -> None:
    half = 1e-5 * SIZES
    slope = (kernel.cost(SIZES + half) - kernel.cost(SIZES - half)) / (2.0 * half)
    np.testing.assert_allclose(kernel.weight(SIZES), slope / SIZES, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_small_residuals_cost_half_their_square_and_weigh_one(kernel: RobustKernel) -> None:
    small = np.array([0.0, 1e-3])
    np.testing.assert_allclose(kernel.cost(small), 0.5 * small**2, rtol=1e-5)
    np.testing.assert_allclose(kernel.weight(small), 1.0, rtol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_cost_never_falls_and_never_exceeds_half_the_square(kernel: RobustKernel) -> None:
    cost = kernel.cost(SIZES)
    assert (np.diff(cost) >= 0.0).all()
    assert (cost <= 0.5 * SIZES**2 * (1.0 + 1e-12)).all()
    weight = kernel.weight(SIZES)
    assert (np.diff(weight) <= 0.0).all()
    assert ((weight >= 0.0) & (weight <= 1.0)).all()


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_residual_without_bounds_has_a_finite_weight(kernel: RobustKernel) -> None:
    assert np.isfinite(kernel.weight(np.array([1e150]))).all()
    assert np.isfinite(kernel.cost(np.array([1e150]))).all()


def test_beyond_its_bound_tukeys_biweight_counts_nothing_more() -> None:
    kernel = Tukey(3.0)
    assert kernel.weight(np.array([3.0, 50.0])).tolist() == [0.0, 0.0]
    np.testing.assert_allclose(kernel.cost(np.array([3.0, 50.0])), 1.5)


def test_the_factors_of_medians_are_those_of_the_normal_distribution() -> None:
    from scipy.stats import norm, rayleigh

    assert pytest.approx(1.0 / norm.ppf(0.75), abs=1e-4) == MAD_TO_SIGMA
    assert pytest.approx(rayleigh.median(), abs=1e-4) == MEDIAN_LENGTH


def test_a_third_of_outliers_hardly_widens_a_spread() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(0.0, 0.2, (4000, 2))
    assert sigma_of(errors) == pytest.approx(0.2, rel=0.03)
    assert sigma_of_lengths(np.linalg.norm(errors, axis=1)) == pytest.approx(0.2, rel=0.03)
    errors[::3] = 1e6
    assert sigma_of(errors) < 0.4


def test_no_residuals_have_no_spread() -> None:
    assert sigma_of(np.zeros(0)) == 0.0
    assert sigma_of_lengths(np.zeros(0)) == 0.0
