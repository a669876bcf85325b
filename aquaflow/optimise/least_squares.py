"""One descent for every least-squares problem of the package: Levenberg-Marquardt.

A problem has states x (poses, depths, a lens: no vectors, in general), a cost

    C(x) = sum_i rho(|r_i(x)|),        r_i in standard deviations, rho a kernel of ``robust``,

and a way to move, x + d, by a step d of its tangent space. One iteration:

    linearise   C(x + d) ~ C(x) + g'd + d'Hd / 2,    g = J'W r,  H = J'W J,  W = rho'(|r|) / |r|
    solve       (H + damping diag H) d = -g
    judge       C(x + d) <= C(x): take the step, and damp less; else stay, and damp more
    stop        once a step is short, or the cost hardly falls

Damping by the diagonal (D. Marquardt, SIAM J. Appl. Math. 11 (1963)) knows no units, so metres,
radians and log-scales go together; without damping the step is Gauss-Newton's. What no residual
measures (a gauge: position, attitude and scale of a whole map) stays where it is. H at the end is
the information of x, and its inverse the covariance.

What keeps a loop of its own says why at its top: ``tracking/graph/optimisation.py`` (unknowns that
grow on the way), ``mapping/optimisation.py`` (derivatives that are drawn),
``survey/change/registration.py`` (pairs that change), ``tracking/learned.py`` (noise of two
parts).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dposv

from aquaflow.optimise.robust import RobustKernel, sigma_of

Array = npt.NDArray[np.float64]
State = TypeVar("State")

LEAST_DIAGONAL = 1e-15
"""Of the largest entry: a smaller one is rounding, not a matter of units, and taken for as much, so
that an unknown that nothing measures stays where it is."""
LEAST_EIGENVALUE = 1e-13
"""Of the largest, in units of the diagonal: below it rounding decides, and nothing is known."""
TINY = float(np.finfo(np.float64).tiny)
LEAST_DAMPING = 1e-9
"""Below it a step is Gauss-Newton's, and a factor exists in spite of a gauge."""


class Linearisation(Protocol):
    """A problem about one state, to second order."""

    @property
    def cost(self) -> float:
        """C there, by the weights that hold until the next linearisation."""

    @property
    def gradient(self) -> Array:
        """[n] g of what steps."""

    def solve(self, damping: float) -> Array | None:
        """[n] the damped step; None where the equations have none, or it is no number."""


class Problem(Protocol[State]):
    """What is to be minimised."""

    def linearise(self, state: State) -> Linearisation:
        """The equations at ``state``. A problem may choose weights, noise or whitening anew here:
        ``cost`` goes by them until the next time."""

    def cost(self, state: State) -> float:
        """C; infinite or NaN where ``state`` makes no sense: it is then not taken."""

    def move(
        self,
        state: State,
        step: Array,  # [P]
    ) -> State:
        """``state`` + step [n], on its manifold."""


@dataclass(frozen=True)
class Rules:
    """How a descent is damped, and when it ends."""

    iterations: int
    """Most of them, those whose step is refused included."""
    decrease: float = 0.0
    """Relative fall of the cost, of a step that is taken, at which the state has converged."""
    sigmas: float = 0.0
    """Length of a step, sqrt(-g'd), in standard deviations of the state, at which it has converged:
    that step is the last, taken or not."""
    slack: float = 1e-12
    """Relative growth of the cost that refuses no step: its rounding."""
    damping: float = 1e-4
    """The first, relative to the diagonal."""
    growth: float = 10.0
    """Factor of the damping after a step that was refused."""
    shrinkage: float = 0.1
    """Factor of the damping after a step that was taken."""
    most_damping: float = 1e6
    """Beyond it no step reduces the cost: the descent ends."""


class Ending(Enum):
    """Why a descent ended."""

    CONVERGED = "converged"
    EXHAUSTED = "all iterations were used"
    STUCK = "no step reduces the cost"
    SINGULAR = "the equations have no solution"
    NOT_FINITE = "the cost is not finite"


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """The best state that a descent found: never worse than its start, ``slack`` aside."""

    state: State
    cost: float
    ending: Ending
    damping: float
    """With which a descent would go on."""
    iterations: int


def minimise(problem: Problem[State], start: State, rules: Rules) -> Minimum[State]:
    """Descend from ``start``. It returns whatever the residuals hold: :class:`Ending` says how."""
    state, cost, damping, equations = start, float("nan"), rules.damping, None
    for iteration in range(rules.iterations):
        if equations is None:
            equations = problem.linearise(state)
            cost = equations.cost
            if not np.isfinite(cost):
                return Minimum(state, cost, Ending.NOT_FINITE, damping, iteration)
        step = equations.solve(damping)
        short, after, trial = False, float("inf"), state
        if step is not None:
            short = -float(equations.gradient @ step) < rules.sigmas**2
            trial = problem.move(state, step)
            after = problem.cost(trial)
        if after <= cost + rules.slack * abs(cost):  # NaN is refused
            flat = rules.decrease > 0.0 and cost - after < rules.decrease * max(cost, 1e-12)
            state, cost, equations = trial, after, None
            damping = max(rules.shrinkage * damping, LEAST_DAMPING)
            if short or flat:
                return Minimum(state, cost, Ending.CONVERGED, damping, iteration + 1)
        elif short:
            return Minimum(state, cost, Ending.CONVERGED, damping, iteration + 1)
        else:
            damping = rules.growth * max(damping, LEAST_DAMPING)
            if damping > rules.most_damping:
                ending = Ending.SINGULAR if step is None else Ending.STUCK
                return Minimum(state, cost, ending, damping, iteration + 1)
    return Minimum(state, cost, Ending.EXHAUSTED, damping, rules.iterations)


@dataclass(frozen=True)
class NormalEquations:
    """Dense equations; those of several terms of a cost add up."""

    H: Array
    """[n, n]"""
    gradient: Array
    """[n] g"""
    cost: float

    @staticmethod
    def of(
        J: Array,  # [M, n] derivative of the residuals
        r: Array,  # [M] in sigmas
        weights: Array | float = 1.0,  # [M] of the squares, by a kernel
        cost: float | None = None,  # by the same kernel; half the squares if None
    ) -> NormalEquations:
        """Normal equations of M residuals."""
        weighted = J * np.broadcast_to(weights, r.shape)[:, None]
        if cost is None:
            cost = 0.5 * float(r @ r)
        return NormalEquations(weighted.T @ J, weighted.T @ r, cost)

    @staticmethod
    def expect(
        departure: Array,  # [n] from the expected value
        sigma: Array,  # [n] of it, infinite where nothing is expected
    ) -> NormalEquations:
        """Expectation of what was known about each number before."""
        r = departure / sigma
        return NormalEquations(np.diag(sigma**-2.0), r / sigma, 0.5 * float(r @ r))

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.H + other.H, self.gradient + other.gradient, self.cost + other.cost
        )

    def solve(self, damping: float) -> Array | None:
        """[n] -(H + damping diag H)^-1 g by Cholesky; None if that is no number."""
        if not len(self.gradient):
            return np.zeros(0)
        if not (np.isfinite(self.H).all() and np.isfinite(self.gradient).all()):
            return None
        scale = _unit_diagonal(self.H)
        A = self.H * np.outer(scale, scale)
        A.flat[:: len(A) + 1] = 1.0 + damping
        _, solution, failed = dposv(A.T, -scale * self.gradient, lower=True, overwrite_a=True)
        step: Array = scale * solution
        return None if failed or not np.isfinite(step).all() else step


@dataclass
class RobustFit:
    """M measurements of n numbers, with noise that nobody states: the median of what is left finds
    it at every linearisation."""

    residuals: Callable[[Array], Array]
    """[M] of x [n]: predicted minus measured, in their own unit."""
    jacobian: Callable[[Array], Array]
    """[M, n] derivatives."""
    kernel: RobustKernel
    expected: Array
    """[n] what x was thought to be before."""
    sigma: Array
    """[n] of that, infinite where nothing was known."""
    least_noise: float
    noise: float = float("nan")
    """1 sigma of a measurement, as last found."""

    def linearise(
        self,
        x: Array,  # [P]
    ) -> NormalEquations:
        """The equations of a step [n]."""
        r = self.residuals(x)
        self.noise = max(sigma_of(r), self.least_noise)
        J, r = self.jacobian(x) / self.noise, r / self.noise
        size = np.abs(r)
        cost = float(self.kernel.cost(size).sum())
        measured = NormalEquations.of(J, r, self.kernel.weight(size), cost)
        return measured + NormalEquations.expect(x - self.expected, self.sigma)

    def cost(
        self,
        x: Array,  # [P]
    ) -> float:
        """The cost by the noise last found."""
        left = (x - self.expected) / self.sigma
        size = np.abs(self.residuals(x)) / self.noise
        return float(self.kernel.cost(size).sum()) + 0.5 * float(left @ left)

    def move(
        self,
        x: Array,  # [P]
        step: Array,  # [P]
    ) -> Array:
        """x [n] + step [n]."""
        return x + step


def covariance_of(
    H: Array,  # [n, n] information, positive semidefinite
) -> Array:
    """[n, n] inverse of an information. Along a direction of which it says nothing the variance is
    huge, never 0; all variances are infinite where it says nothing at all or is no number.

    By the eigenvalues of the matrix of unit diagonal: entries in m, rad and log-scale differ by
    many orders of magnitude, and an inverse would lose the small ones.
    """
    diagonal = np.diag(H)
    if not len(H) or not (np.isfinite(H).all() and diagonal.max() > 0.0):
        return np.diag(np.full(len(H), np.inf))
    scale = _unit_diagonal(H)
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    values = np.maximum(values, LEAST_EIGENVALUE * values[-1])
    whole = scale[:, None] * vectors / np.sqrt(values)
    return np.asarray(whole @ whole.T)


def _unit_diagonal(
    H: Array,  # [n, n]
) -> Array:
    """[n] by which rows and columns are multiplied."""
    diagonal = np.diag(H)
    least = max(LEAST_DIAGONAL * float(diagonal.max()), TINY)
    return np.asarray(1.0 / np.sqrt(np.maximum(diagonal, least)))
