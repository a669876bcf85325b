"""Least squares for the water: robust cost, normal equations, and what the fit leaves unknown."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.water.model import WaterModel
from aquaflow.mapping.water.observations import variance_over_range

Array = npt.NDArray[np.float64]

MAX_STEPS = 30
"""Limit of Levenberg-Marquardt in one fit."""
LEAST_GAIN = 1e-5
"""Relative fall of the cost at which a fit has converged."""
TINY = 1e-12
"""Guards a division where the observations say nothing at all."""
DAMPING = 1e-3, 1e6
"""Levenberg-Marquardt's first damping, and the one at which no step helps any more."""


@dataclass(frozen=True)
class Fit:
    """The best parameters of one model, at a stated noise of the observations."""

    problem: WaterModel
    x: Array
    """[K]"""
    noise: float

    @cached_property
    def information(self) -> Array:
        """[K, K] inverse covariance of the parameters; exact where the cost is a square."""
        return normal_equations(self.problem, self.x, self.noise)[0]

    @cached_property
    def covariance(self) -> Array:
        """[K, K]"""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True))

    @cached_property
    def repeated_covariance(self) -> Array:
        """[K, K] of what this very model leaves, which may be more alike than what the richest
        leaves; that one stated the noise."""
        return max(self.repetition(), 1.0) * self.covariance

    @property
    def log_evidence(self) -> float:
        """Log of the model's marginal likelihood by Laplace's method, up to a constant that all
        models of the same observations share."""
        _, rows = self.problem.priors(self.x)
        prior, posterior = (np.linalg.slogdet(H)[1] for H in (rows.T @ rows, self.information))
        return float(0.5 * (prior - posterior - cost(self.problem, self.x, self.noise)))

    def colours(self) -> Array:
        """[3, P] the points' colours without water."""
        return np.stack([self.problem.predict(self.x, c)[1] for c in range(3)])

    def restored_variance(self) -> float:
        """Of the observations with the water taken out of each (``variance_over_range``)."""
        restored = [self.problem.without_water(self.x, c) for c in range(3)]
        return variance_over_range(self.problem.seen, np.stack(restored, axis=-1))

    def spread(self) -> float:
        """Standard deviation of an observation's error, outliers left out."""
        errors = [np.abs(self.problem.predict(self.x, c)[0]) for c in range(3)]
        return float(np.median(errors)) / 0.6745

    def repetition(self) -> float:
        """How often the same error is counted: neighbouring points share the map's errors, and the
        observations of a point its own.

        The variance that the gradients of whole regions show over the one that they would have,
        if each observation's error were its own, in the directions that the fit leaves unknown.
        """
        first = self.problem.exposure.start
        expected, found = np.zeros((2, first, first))
        for c in range(3):
            own = self.problem.of_channel(c)
            own = own[own < first]
            errors = self.problem.predict(self.x, c)[0]
            by_error = self.problem.derivatives(self.x, c)[0][: len(own)]
            weighed = by_error * _weight(errors, self.noise)
            by_region = self.problem.sums_by_region(weighed * errors)
            expected[np.ix_(own, own)] += weighed @ by_error.T
            found[np.ix_(own, own)] += by_region @ by_region.T
        covariance = self.covariance[:first, :first]
        alone = max(float((covariance * expected).sum()), TINY)
        return float((covariance * found).sum()) / alone


def descend(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> Fit:
    """Levenberg-Marquardt on the robust cost."""
    damping, give_up = DAMPING
    best = cost(problem, x, noise)
    for _ in range(MAX_STEPS if problem.size else 0):
        H, g = normal_equations(problem, x, noise)
        before = best
        while damping < give_up:
            trial = x - np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            new = cost(problem, trial, noise)
            if new < best:
                x, best, damping = trial, new, damping / 10.0
                break
            damping *= 10.0
        if before - best < LEAST_GAIN * before:
            break
    return Fit(problem, x, noise)


def cost(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> float:
    """Soft L1 of the observations' whitened errors and squares of the priors', together."""
    total = float((problem.priors(x)[0] ** 2).sum())
    predicted = [problem.predict(x, c) for c in range(3)]
    for errors, _ in predicted:
        total += float(2.0 * (np.sqrt(1.0 + (errors / noise) ** 2) - 1.0).sum())
    return total + float((problem.of_scene(np.stack([J for _, J in predicted])) ** 2).sum())


def normal_equations(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> tuple[Array, Array]:
    """J^T W J and J^T W r of the same cost, the weights those of soft L1."""
    residuals, rows = problem.priors(x)
    H, g = rows.T @ rows, rows.T @ residuals
    colours, changes = [], []
    for c in range(3):
        own = problem.of_channel(c)
        errors, J = problem.predict(x, c)
        by_error, by_J = problem.derivatives(x, c)
        weight = _weight(errors, noise)
        H[np.ix_(own, own)] += (weight * by_error) @ by_error.T
        g[own] += by_error @ (weight * errors)
        colours.append(J)
        changes.append((own, by_J))
    J = np.stack(colours)
    rows = problem.of_scene_rows(J, changes)
    return H + rows.T @ rows, g + rows.T @ problem.of_scene(J)


def _weight(
    errors: Array,  # [M]
    noise: float,
) -> Array:
    return np.asarray(1.0 / (noise**2 * np.sqrt(1.0 + (errors / noise) ** 2)))
