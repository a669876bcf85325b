"""Least squares for the water: robust cost, normal equations, and what the fit leaves unknown."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.least_squares import Ending, NormalEquations, Rules, minimise
from aquaflow.optimise.robust import SoftL1, sigma_of
from aquaflow.water.model import Derivatives, Prediction, WaterModel

Array = npt.NDArray[np.float64]

KERNEL = SoftL1()
"""Of an observation's error in one channel."""
STEPS_AT_ONCE, MOST_ROUNDS = 5, 10
"""Iterations between two pauses, each takes 3 to 6 ms; and how often in one fit at most."""
LEAST_GAIN = 1e-5
"""Relative fall of the cost at which a fit has converged."""
TINY = 1e-12
"""Guards a division where the observations say nothing at all."""
FIRST_DAMPING = 1e-3
"""Relative to the diagonal: rates and colours start far from the minimum."""


@dataclass(frozen=True)
class WaterFit:
    """The best parameters of one model, at a stated noise of the observations."""

    problem: WaterModel
    x: Array
    """[K]"""
    noise: float
    weight: Array
    """[3, M] of the observations, by their errors."""

    @cached_property
    def prediction(self) -> Prediction:
        """The observations through the fitted water."""
        return self.problem.predict(self.x, self.weight)

    @cached_property
    def information(self) -> Array:
        """[K, K] inverse covariance of the parameters; exact where the cost is a square."""
        return normal_equations(self.problem, self.x, self.prediction, self.weight)[0]

    @cached_property
    def covariance(self) -> Array:
        """[K, K]"""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True))

    @cached_property
    def repeated_covariance(self) -> Array:
        """[K, K] by errors as alike as this very model's are; the richest stated the noise."""
        return max(self.repetition(), 1.0) * self.covariance

    @cached_property
    def log_evidence(self) -> float:
        """Log of the marginal likelihood (Laplace), but for what all models here share."""
        _, rows = self.problem.priors(self.x)
        prior, posterior = (np.linalg.slogdet(H)[1] for H in (rows.T @ rows, self.information))
        found = cost(self.problem, self.x, self.prediction, self.noise)
        return float(0.5 * (prior - posterior - found))

    def spread(self) -> float:
        """Standard deviation of an observation's error, outliers left out."""
        return sigma_of(self.prediction.errors)

    def repetition(self) -> float:
        """How often the same error is counted: neighbouring points share the light that plays on
        them, the three channels too, and the observations of a point its own.

        The variance that the gradients of whole regions show over the one that they would have,
        if each observation's error were its own, in the directions that the fit leaves unknown.
        """
        first = self.problem.exposure.start
        shared = self.problem.seen.errors_shared
        expected, scores = np.zeros((first, first)), np.zeros((first, int(shared.max()) + 1))
        for c in range(3):
            found = self.problem.derivatives(self.prediction, self.weight[c], c)
            own = found.own[: len(found.direct)]
            weighed = found.direct * self.weight[c]
            by_J = found.by_J[: len(own)]
            each = self.problem.seen.sums_by_point(weighed * self.prediction.a[c])
            expected[np.ix_(own, own)] += weighed @ found.direct.T + by_J @ each.T
            for k, row in zip(own, weighed * self.prediction.errors[c], strict=True):
                scores[k] += np.bincount(shared, row, scores.shape[1])
        covariance = self.covariance[:first, :first]
        alone = max(float((covariance * expected).sum()), TINY)
        return float((covariance * (scores @ scores.T)).sum()) / alone


def descend(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> Generator[None, None, WaterFit]:
    """The parameters of least robust cost; pauses every few iterations."""
    descent = _Descent(problem, noise)
    rules = Rules(STEPS_AT_ONCE, decrease=LEAST_GAIN, damping=FIRST_DAMPING)
    for _ in range(MOST_ROUNDS if problem.size else 0):
        found = minimise(descent, x, rules)
        x, rules = found.state, replace(rules, damping=found.damping)
        yield
        if found.ending is not Ending.EXHAUSTED:
            break
    weight = descent.reweigh(x)
    return WaterFit(descent.problem, x, noise, weight)


class _Descent:
    """The water as a problem of least squares; its priors and weights follow the parameters."""

    def __init__(self, problem: WaterModel, noise: float) -> None:
        self.problem, self._noise = problem, noise
        self._weight: Array | None = None
        self._last: tuple[Array, Prediction] | None = None

    def reweigh(
        self,
        x: Array,  # [K]
    ) -> Array:
        """[3, M] the weights that go with ``x``; they are taken from now on, as its priors are."""
        before = self._predict(x)
        self.problem, self._last = self.problem.expecting(x), None
        self._weight = weights(self.problem, before, self._noise)
        return self._weight

    def linearise(
        self,
        x: Array,  # [K]
    ) -> NormalEquations:
        """The equations of a step [K], by new weights."""
        weight = self.reweigh(x)
        H, gradient = normal_equations(self.problem, x, self._predict(x), weight)
        return NormalEquations(H, gradient, self.cost(x))

    def cost(
        self,
        x: Array,  # [K]
    ) -> float:
        """Half the robust cost."""
        return 0.5 * cost(self.problem, x, self._predict(x), self._noise)

    def move(
        self,
        x: Array,  # [K]
        step: Array,  # [K]
    ) -> Array:
        """Their sum."""
        return x + step

    def _predict(
        self,
        x: Array,  # [K]
    ) -> Prediction:
        if self._last is None or self._last[0] is not x:
            self._last = x, self.problem.predict(x, self._weight)
        return self._last[1]


def cost(
    problem: WaterModel,
    x: Array,  # [K] parameters
    now: Prediction,
    noise: float,
) -> float:
    """Soft L1 of the observations' whitened errors and squares of the priors', together."""
    total = float((problem.priors(x)[0] ** 2).sum())
    whitened = now.errors / (noise * problem.seen.error_scale)
    total += float(2.0 * KERNEL.cost(whitened).sum())
    return total + float((problem.of_scene(now.J) ** 2).sum())


def normal_equations(
    problem: WaterModel,
    x: Array,  # [K] parameters
    now: Prediction,
    weight: Array,  # [3, M]
) -> tuple[Array, Array]:
    """J^T W J and J^T W r of the same cost, the points' colours eliminated."""
    residuals, rows = problem.priors(x)
    H, g = rows.T @ rows, rows.T @ residuals
    changes = []
    for c in range(3):
        found = problem.derivatives(now, weight[c], c)
        block, slope = _of_channel(problem, found, now, weight[c], c)
        H[np.ix_(found.own, found.own)] += block
        g[found.own] += slope
        changes.append((found.own, found.by_J))
    scene = problem.of_scene_rows(now.J, changes)
    return H + scene.T @ scene, g + scene.T @ problem.of_scene(now.J)


def _of_channel(
    problem: WaterModel,
    found: Derivatives,
    now: Prediction,
    w: Array,  # [M] weights
    c: int,
) -> tuple[Array, Array]:
    """[k, k] and [k]: one channel's share of both, by its own parameters."""
    seen, errors = problem.seen, now.errors[c]
    weighed, k = found.direct * w, len(found.direct)
    H = np.zeros((len(found.own), len(found.own)))
    H[:k, :k] = weighed @ found.direct.T
    g = np.concatenate([weighed @ errors, np.zeros(len(found.own) - k)])
    if problem.model.exposure:
        views = problem.views
        by_view = [np.bincount(seen.view, row * found.lit, views) for row in weighed]
        alone = np.diag(np.bincount(seen.view, w * found.lit**2, views))
        slope = np.bincount(seen.view, w * found.lit * errors, views)
        # Only what differs from the mean gain has an effect.
        if k:
            cross = np.stack(by_view)
            H[:k, k:] = cross - cross.mean(axis=1, keepdims=True)
            H[k:, :k] = H[:k, k:].T
        alone = alone - alone.mean(axis=0)
        H[k:, k:] = alone - alone.mean(axis=1, keepdims=True)
        g[k:] = slope - slope.mean()
    # sum w (d + a dJ)^2 = sum w d^2 - power dJ^2, as dJ is the best there is.
    H -= (found.by_J * now.power[c]) @ found.by_J.T
    g += found.by_J @ seen.sums_by_point(w * now.a[c] * errors)
    return H, g


def weights(problem: WaterModel, now: Prediction, noise: float) -> Array:
    """[3, M] of the observations, those of soft L1."""
    sigma = noise * problem.seen.error_scale
    return np.asarray(KERNEL.weight(now.errors / sigma) / sigma**2)
