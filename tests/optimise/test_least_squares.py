"""The descent on problems whose answers are known, and on problems that have none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.optimise.least_squares import (
    Ending,
    NormalEquations,
    Rules,
    covariance_of,
    minimise,
)
from aquaflow.optimise.robust import Huber

Array = npt.NDArray[np.float64]
RULES = Rules(iterations=60, sigmas=1e-8)
GAUSS_NEWTON = replace(RULES, damping=0.0)


@dataclass
class Linear:
    """A x = y with unit noise."""

    A: Array
    y: Array

    def residuals(self, x: Array) -> Array:
        return np.asarray(self.A @ x - self.y)

    def linearise(self, x: Array) -> NormalEquations:
        return NormalEquations.of(self.A, self.residuals(x))

    def cost(self, x: Array) -> float:
        r = self.residuals(x)
        return 0.5 * float(r @ r)

    def move(self, x: Array, step: Array) -> Array:
        return x + step


@dataclass
class Rotation:
    """R a_i = b_i: three numbers on a manifold, some of the pairs wrong."""

    a: Array
    """[M, 3]"""
    b: Array
    """[M, 3]"""
    sigma: float = 0.01
    kernel: Huber = field(default_factory=Huber)

    def residuals(self, R: Array) -> Array:
        return np.asarray((self.a @ R.T - self.b) / self.sigma)

    def jacobian(self, R: Array) -> Array:
        turned = self.a @ R.T
        return np.asarray(np.cross(np.eye(3), turned[:, None]).transpose(0, 2, 1) / self.sigma)

    def linearise(self, R: Array) -> NormalEquations:
        r, J = self.residuals(R), self.jacobian(R)
        size = np.linalg.norm(r, axis=1)
        weights = np.repeat(self.kernel.weight(size), 3)
        return NormalEquations.of(J.reshape(-1, 3), r.ravel(), weights, self.cost(R))

    def cost(self, R: Array) -> float:
        return float(self.kernel.cost(np.linalg.norm(self.residuals(R), axis=1)).sum())

    def move(self, R: Array, step: Array) -> Array:
        return so3_exp(step) @ R


class Rosenbrock(Linear):
    """A bent valley that Gauss-Newton leaves: 10 (y - x^2), 1 - x."""

    def __init__(self) -> None:
        super().__init__(np.eye(2), np.zeros(2))

    def residuals(self, x: Array) -> Array:
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def linearise(self, x: Array) -> NormalEquations:
        J = np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])
        return NormalEquations.of(J, self.residuals(x))


def turned_pairs(seed: int, outliers: float = 0.0) -> tuple[Rotation, Array]:
    rng = np.random.default_rng(seed)
    R, a = so3_exp(rng.normal(size=3)), rng.normal(size=(200, 3))
    b = a @ R.T + 0.01 * rng.normal(size=a.shape)
    wrong = rng.random(len(b)) < outliers
    b[wrong] = rng.normal(size=(int(wrong.sum()), 3))
    return Rotation(a, b), R


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_problem_is_solved_in_one_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = Linear(rng.normal(size=(30, 5)), rng.normal(size=30))
    found = minimise(problem, np.zeros(5), GAUSS_NEWTON)
    np.testing.assert_allclose(found.state, np.linalg.lstsq(problem.A, problem.y)[0], atol=1e-12)
    assert (found.ending, found.iterations) == (Ending.CONVERGED, 2)


@pytest.mark.parametrize("seed", range(4))
def test_a_rotation_is_found_from_half_a_turn_away_in_spite_of_outliers(seed: int) -> None:
    problem, R = turned_pairs(seed, outliers=0.3)
    start = so3_exp(np.array([1.5, 0.0, 0.0])) @ R
    found = minimise(problem, start, RULES)
    sigmas = np.sqrt(np.diag(covariance_of(problem.linearise(found.state).H)))
    away = Sim3(found.state @ R.T, np.zeros(3)).log()[3:6]
    assert found.ending is Ending.CONVERGED
    assert (np.abs(away) < 5.0 * sigmas).all()


def test_the_gradient_is_that_of_the_robust_cost() -> None:
    problem, R = turned_pairs(0, outliers=0.3)
    at = so3_exp(np.array([0.2, -0.1, 0.3])) @ R
    differences = [
        (problem.cost(problem.move(at, step)) - problem.cost(problem.move(at, -step))) / 2e-6
        for step in 1e-6 * np.eye(3)
    ]
    np.testing.assert_allclose(problem.linearise(at).gradient, differences, rtol=1e-6)


def test_a_bent_valley_is_followed_to_its_end() -> None:
    found = minimise(Rosenbrock(), np.array([-1.2, 1.0]), replace(RULES, iterations=200))
    assert found.ending is Ending.CONVERGED
    np.testing.assert_allclose(found.state, 1.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_cost_never_grows(seed: int) -> None:
    start = 5.0 * np.random.default_rng(seed).normal(size=2)
    costs = [
        minimise(Rosenbrock(), start, Rules(iterations, sigmas=1e-8)).cost
        for iterations in range(1, 30)
    ]
    assert (np.diff(costs) <= 1e-9 * np.array(costs[1:])).all()


def test_a_gauge_stays_where_it_is() -> None:
    """Differences of three numbers: their mean is never measured."""
    A = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, -1.0]])
    found = minimise(Linear(A, np.array([1.0, 2.0, 3.0])), np.array([4.0, 0.0, 2.0]), RULES)
    np.testing.assert_allclose(A @ found.state, [1.0, 2.0, 3.0], atol=1e-7)
    assert found.state.mean() == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_an_unknown_that_nothing_measures_stays_where_it_is(damping: float) -> None:
    problem = Linear(np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([3.0, 3.0]))
    found = minimise(problem, np.array([0.0, 7.0]), replace(RULES, damping=damping))
    np.testing.assert_allclose(found.state, [3.0, 7.0], atol=1e-9)
    assert found.ending is Ending.CONVERGED


def test_what_rounding_leaves_of_a_derivative_moves_nothing() -> None:
    """As eliminated depths leave it of a scale that they do not know."""
    H = np.diag([3e4, 1e-29])
    step = NormalEquations(H, np.array([500.0, 1e-14]), 1.0).solve(1e-6)
    assert step is not None
    np.testing.assert_allclose(step, [-500.0 / 3e4, 0.0], rtol=1e-5, atol=1e-3)


def test_no_residuals_and_no_unknowns_leave_the_state() -> None:
    start = np.array([1.0, 2.0])
    nothing = minimise(Linear(np.zeros((0, 2)), np.zeros(0)), start, RULES)
    np.testing.assert_array_equal(nothing.state, start)
    assert nothing.ending is Ending.CONVERGED
    empty = minimise(Linear(np.zeros((3, 0)), np.ones(3)), np.zeros(0), RULES)
    assert (len(empty.state), empty.ending) == (0, Ending.CONVERGED)
    untried = minimise(Linear(np.eye(2), np.ones(2)), start, replace(RULES, iterations=0))
    np.testing.assert_array_equal(untried.state, start)
    assert untried.ending is Ending.EXHAUSTED


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_residuals_that_are_no_numbers_or_overflow_leave_the_state(bad: float) -> None:
    problem = Linear(np.eye(2), np.array([1.0, bad]))
    with np.errstate(over="ignore", invalid="ignore"):
        found = minimise(problem, np.zeros(2), RULES)
    assert found.ending is Ending.NOT_FINITE
    np.testing.assert_array_equal(found.state, 0.0)


def test_huge_residuals_are_fitted_as_small_ones_are() -> None:
    found = minimise(Linear(np.eye(2), np.array([1.0, 1e100])), np.zeros(2), RULES)
    np.testing.assert_allclose(found.state[1], 1e100)


def test_derivatives_that_are_no_numbers_are_singular_equations() -> None:
    class Broken(Linear):
        def linearise(self, x: Array) -> NormalEquations:
            return replace(super().linearise(x), H=np.full((2, 2), np.nan))

    found = minimise(Broken(np.eye(2), np.ones(2)), np.zeros(2), RULES)
    assert found.ending is Ending.SINGULAR
    np.testing.assert_array_equal(found.state, 0.0)


def test_a_cost_that_every_step_raises_leaves_the_state() -> None:
    class Wrong(Linear):
        def linearise(self, x: Array) -> NormalEquations:
            right = super().linearise(x)
            return replace(right, gradient=-right.gradient)

    found = minimise(Wrong(np.eye(2), np.ones(2)), np.zeros(2), RULES)
    assert found.ending is Ending.STUCK
    np.testing.assert_array_equal(found.state, 0.0)


def test_a_state_that_has_no_cost_is_not_taken() -> None:
    """log x = 1 from far above: the first step leads below zero."""

    class Logarithm(Linear):
        def residuals(self, x: Array) -> Array:
            return np.log(np.where(x > 0.0, x, np.nan)) - 1.0

        def linearise(self, x: Array) -> NormalEquations:
            return NormalEquations.of(np.diag(1.0 / x), self.residuals(x))

    found = minimise(Logarithm(np.eye(1), np.zeros(1)), np.array([100.0]), RULES)
    np.testing.assert_allclose(found.state, np.e, rtol=1e-6)


def test_terms_of_a_cost_add_up() -> None:
    rng = np.random.default_rng(0)
    J, r, sigma = rng.normal(size=(6, 3)), rng.normal(size=6), np.array([1.0, 2.0, np.inf])
    departure = rng.normal(size=3)
    both = NormalEquations.of(J, r) + NormalEquations.expect(departure, sigma)
    whole = NormalEquations.of(
        np.vstack([J, np.diag(1.0 / sigma)]), np.concatenate([r, departure / sigma])
    )
    np.testing.assert_allclose(both.H, whole.H)
    np.testing.assert_allclose(both.gradient, whole.gradient)
    assert both.cost == pytest.approx(whole.cost)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_the_scatter_of_solutions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, true = rng.normal(size=(12, 3)), rng.normal(size=3)
    problems = [Linear(A, A @ true + rng.normal(size=12)) for _ in range(3000)]
    found = [minimise(each, np.zeros(3), GAUSS_NEWTON).state for each in problems]
    expected = covariance_of(problems[0].linearise(true).H)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(np.array(found).T) / scale, expected / scale, atol=0.1)


def test_the_covariance_is_the_inverse_of_the_hessian_whatever_the_units() -> None:
    rng = np.random.default_rng(1)
    units = np.array([1e-3, 1e-2, 1.0, 1e4])
    A = rng.normal(size=(20, 4))
    covariance = covariance_of((A * units).T @ (A * units))
    np.testing.assert_allclose(
        covariance * np.outer(units, units), np.linalg.inv(A.T @ A), rtol=1e-9
    )


def test_along_a_direction_that_nothing_measures_the_variance_is_huge_and_elsewhere_right() -> None:
    gauge = covariance_of(np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert gauge[0, 0] > 1e12
    between = np.array([1.0, -1.0])
    assert between @ gauge @ between == pytest.approx(1.0, rel=1e-2)
    never = covariance_of(np.diag([4.0, 0.0]))
    assert never[0, 0] == pytest.approx(0.25)
    assert 1e12 < never[1, 1] < np.inf


@pytest.mark.parametrize("H", [np.zeros((2, 2)), np.full((2, 2), np.nan)])
def test_without_information_all_variances_are_infinite(H: Array) -> None:
    assert np.isinf(np.diag(covariance_of(H))).all()


def test_the_covariance_of_no_unknowns_is_empty() -> None:
    assert covariance_of(np.zeros((0, 0))).shape == (0, 0)
