"""The solver: known answers, outliers, covariance, and what it refuses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.telemetry.factors import Factor, LengthFactor
from aquaflow.telemetry.solve import Solution, solve
from aquaflow.telemetry.start import Process, SlowPart
from aquaflow.telemetry.state import HEADING, SCALE, SHIFT, TURN, MetricState, P
from tests.telemetry.exact_scene import ExactScene, disturbed

Array = npt.NDArray[np.float64]

PRIOR = np.full(P, 1e3)
START = MetricState(0.0, np.eye(3), np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
SIGMA = 0.02


class Points(Factor):
    """Points of the map, measured in n: exact geometry, white noise."""

    kind = "points"
    slow = SlowPart(1e-6, 1.0, (Process(2.0),))
    spans = (SCALE, TURN, SHIFT)

    def __init__(self, points_m: Array, points_n: Array) -> None:
        self.source, self.t_s = "test", np.arange(len(points_m), dtype=np.float64)
        self.sigma = np.full(len(points_m), SIGMA)
        self._m, self._n = points_m, points_n

    def residuals(self, state: MetricState) -> Array:
        """[N, 3] m."""
        return np.asarray(state.scale * self._m @ state.R_nm.T + state.t_n - self._n)


def truth(seed: int) -> MetricState:
    return disturbed(START, seed, 0.4)


def points(
    state: MetricState, rng: np.random.Generator, count: int = 40, noise: float = 1.0
) -> Points:
    m = rng.normal(size=(count, 3))
    n = state.scale * m @ state.R_nm.T + state.t_n
    return Points(m, n + noise * SIGMA * rng.normal(size=n.shape))


def error(solution: Solution, true: MetricState) -> Array:
    """[7] of log-scale, turn and shift, as a step from the solution to the truth."""
    found = solution.state
    turn = Rotation.from_matrix(true.R_nm @ found.R_nm.T).as_rotvec()
    return np.concatenate([[true.log_scale - found.log_scale], turn, true.t_n - found.t_n])


@pytest.mark.parametrize("seed", range(5))
def test_exact_measurements_give_the_exact_state(seed: int) -> None:
    true = truth(seed)
    solution = solve([points(true, np.random.default_rng(seed), noise=0.0)], START, PRIOR)
    np.testing.assert_allclose(error(solution, true), 0.0, atol=1e-6)


def test_all_instruments_of_an_exact_dive_agree_on_its_state() -> None:
    scene = ExactScene.drawn(4)
    prior = np.full(P, 0.3)
    factors = [f for f in scene.factors() if f.kind != "dead_reckoning"]
    # Stated mountings are right: what is not observable stays there.
    start = scene.state.move(np.concatenate([0.05 * np.ones(7), np.zeros(P - 7)]))
    prior[TURN], prior[SCALE], prior[SHIFT] = 3.0, 3.0, 1e3
    prior[HEADING] = 1e-3
    solution = solve(factors, start, prior)
    np.testing.assert_allclose(error(solution, scene.state), 0.0, atol=1e-3)
    assert all(kept.all() for kept in solution.kept)


def test_the_covariance_is_the_scatter_of_many_solutions() -> None:
    true, errors, stated = truth(0), [], []
    m = np.random.default_rng(1).normal(size=(30, 3))
    n = true.scale * m @ true.R_nm.T + true.t_n
    for seed in range(200):
        rng = np.random.default_rng(seed)
        solution = solve([Points(m, n + SIGMA * rng.normal(size=n.shape))], START, PRIOR)
        errors.append(error(solution, true))
        stated.append(solution.covariance[:7, :7])
    scatter, covariance = np.cov(np.array(errors).T), np.mean(stated, axis=0)
    ratio = np.sqrt(np.diag(scatter) / np.diag(covariance))
    assert (ratio > 0.8).all()  # noise is never taken to be under the data sheet, so a little over
    assert (ratio < 1.15).all()
    nees = [e @ np.linalg.solve(C, e) for e, C in zip(errors, stated, strict=True)]
    assert 0.7 * 7 < np.mean(nees) < 1.15 * 7


def test_outliers_are_left_out_and_reported() -> None:
    true, rng = truth(2), np.random.default_rng(2)
    factor = points(true, rng, count=60)
    wrong = np.array([5, 17, 18, 40])
    factor._n[wrong] += np.array([2.0, -3.0, 1.0])
    solution = solve([factor], START, PRIOR)
    assert not solution.kept[0][wrong].any()
    assert (~solution.kept[0]).sum() <= len(wrong) + 1
    sigma = np.sqrt(np.diag(solution.covariance)[:7])
    assert (np.abs(error(solution, true)) < 4.0 * sigma).all()


def test_what_nothing_measures_keeps_its_prior() -> None:
    prior = np.linspace(0.1, 1.0, P)
    solution = solve([], START, prior)
    assert solution.state.scale == START.scale
    assert not solution.state.t_n.any()
    np.testing.assert_allclose(np.sqrt(np.diag(solution.covariance)), prior)
    length = LengthFactor("bar", np.array([2.0]), np.array([1e-6]), 1.0, 0.001)
    prior[SCALE] = 3.0
    solution = solve([length], START, prior)
    assert solution.state.scale == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(solution.covariance))[1:], prior[1:])


def test_noise_above_the_data_sheet_widens_the_covariance() -> None:
    true = truth(3)
    quiet, loud = (
        solve([points(true, np.random.default_rng(3), noise=noise)], START, PRIOR)
        for noise in (1.0, 5.0)
    )
    ratio = np.sqrt(np.diag(loud.covariance)[:7] / np.diag(quiet.covariance)[:7])
    assert (ratio > 3.0).all()


def test_information_adds_up_to_the_inverse_of_the_covariance() -> None:
    true, rng = truth(4), np.random.default_rng(4)
    solution = solve([points(true, rng), points(true, rng)], START, PRIOR)
    total = sum(solution.information, np.diag(PRIOR**-2))
    np.testing.assert_allclose(total @ solution.covariance, np.eye(P), atol=1e-3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_residuals_that_are_not_finite_are_refused(value: float) -> None:
    factor = points(truth(0), np.random.default_rng(0))
    factor._n[3] = value
    with np.errstate(invalid="ignore"), pytest.raises(ArithmeticError, match="not finite"):
        solve([factor], START, PRIOR)
