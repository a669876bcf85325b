"""The water, the camera's shading and the views' exposures, from points seen at several ranges.

A point's colour J is unknown but the same from everywhere; what changes with range is the water:
the contrast between bright and dark points decays by exp(-beta z), and their common level moves
towards B_inf. Photometric gradients alone hardly move the water, because every Gaussian's colour
can follow its error.

Lamps and lenses darken the picture towards its edge, and near ground is seen near the edge: left
out, that looks like water. So does light that changes while the vehicle climbs. And in air or clear
water there is nothing to find at all. Which of the three are there is chosen by the Bayesian
information criterion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig
from aquaflow.mapping.sighted_points import Observations, informative
from aquaflow.mapping.water_model import DARK_SIGMA, NOISE, Model, WaterModel

Array = npt.NDArray[np.float64]

MIN_POINTS = 100
"""Fewer points seen at several ranges say nothing about the water."""
POINTS_PER_VALUE = 10.0
"""Neighbouring points share the map's errors, so that this many say what one could alone. Were all
independent, dives without water would get some: it saves them up to 14 % of the error, where true
water, the clearest of Jerlov's too, saves 30 to 60 %."""
WATER_IS_USUAL = 10.0
"""Log odds for water before anything is seen: a dive is in water until very strong evidence (5,
Kass and Raftery 1995), twice over, speaks against it. Clear dives give -14 and -20, Curasao, where
a shading of the picture explains as much, -6 to 17, other dives in water over 100."""
MAX_STEPS = 30
LEAST_GAIN = 1e-5
"""Relative fall of the cost at which a fit has converged."""
DAMPING = 1e-3, 1e6
"""Levenberg-Marquardt's first damping, and the one at which no step helps any more."""
EVERY_MODEL = tuple(Model(*parts) for parts in product((False, True), repeat=3))
"""With and without water, shading and changing exposure."""


@dataclass(frozen=True)
class WaterEstimate:
    """What lies between the points and the pictures; rates per map unit."""

    model: Model
    """Which of the parts below are there; the others have no effect."""
    beta_a: Array
    """[3]"""
    B_inf: Array
    """[3]"""
    b: Array
    """[3]"""
    beta_a_sigma: list[float] | None
    """[3] relative standard deviation of beta_a; None without water."""
    shading: Array
    """[5] coefficients of the log-gain."""
    exposure: Array
    """[V, 3] log-gain of each view, of mean zero."""
    evidence: float | None
    """For water against none, in units of the log likelihood, WATER_IS_USUAL not counted; None:
    only one of the two was tried."""


@dataclass(frozen=True)
class _Fit:
    problem: WaterModel
    x: Array
    error: float
    """Mean absolute error of the sightings."""
    noise: float

    @property
    def criterion(self) -> float:
        """Bayesian information criterion."""
        values = 3 * self.problem.seen.points / POINTS_PER_VALUE
        likelihood = -values * np.log(max(self.error, 1e-12))
        return float(self.problem.free * np.log(values) - 2.0 * likelihood)


def models_for(config: MediumConfig) -> list[Model]:
    """What the config lets the sightings choose from."""
    water = {config.enabled, config.enabled and not config.off_when_clear}
    return [
        model
        for model in EVERY_MODEL
        if model.water in water
        and (config.shading or not model.shading)
        and (config.exposure or not model.exposure)
    ]


def estimate_water(
    observations: Observations,
    B_res: Array,  # [3]
    d: Array,  # [3] 1 / map unit
    start_beta: float,
    models: Sequence[Model] = EVERY_MODEL,
) -> WaterEstimate | None:
    """Fit ``models`` and keep the likeliest; None where too few points span a range."""
    seen = informative(observations)
    if seen.points < MIN_POINTS:
        return None
    fits: list[_Fit] = []
    for model in models:
        fits.append(_solve(WaterModel(seen, model, B_res, d, start_beta), fits))
    best = min(fits, key=lambda fit: fit.criterion - 2.0 * WATER_IS_USUAL * fit.problem.model.water)
    trial = best.problem.trial(best.x)
    return WaterEstimate(
        best.problem.model,
        trial.beta_a,
        trial.B_inf,
        trial.b,
        _beta_a_sigma(best) if best.problem.model.water else None,
        trial.shading,
        trial.exposure,
        _evidence(fits),
    )


def _evidence(fits: list[_Fit]) -> float | None:
    """Half the difference in the criterion between the best fits without water and with it."""
    dry = [fit.criterion for fit in fits if not fit.problem.model.water]
    wet = [fit.criterion for fit in fits if fit.problem.model.water]
    return 0.5 * (min(dry) - min(wet)) if dry and wet else None


def _solve(problem: WaterModel, before: Sequence[_Fit]) -> _Fit:
    """From the best of the problem's own start and of simpler models' fits, which it contains.

    Parameters, mean absolute error, and the noise that gives every point one vote.

    Sightings of one point share its errors, so they count together as one; a second fit weighs them
    against the priors by the noise that the first one found.
    """
    starts = [problem.start, *(problem.adopt(fit.problem, fit.x) for fit in before)]
    x = _descend(problem, min(starts, key=lambda x: _cost(problem, x, NOISE)), NOISE)
    errors = [np.abs(problem.look(x, c)[0]) for c in range(3)]
    spread = float(np.median(errors)) / 0.6745
    noise = max(spread, NOISE) * float(np.sqrt(len(problem.seen.z) / problem.seen.points))
    x = _descend(problem, x, noise)
    errors = [np.abs(problem.look(x, c)[0]) for c in range(3)]
    return _Fit(problem, x, float(np.mean(errors)), noise)


def _descend(problem: WaterModel, x: Array, noise: float) -> Array:
    """Levenberg-Marquardt on the robust cost."""
    damping, give_up = DAMPING
    cost = _cost(problem, x, noise)
    for _ in range(MAX_STEPS if problem.size else 0):
        H, g = _normal_equations(problem, x, noise)
        before = cost
        while damping < give_up:
            trial = x - np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            new = _cost(problem, trial, noise)
            if new < cost:
                x, cost, damping = trial, new, damping / 10.0
                break
            damping *= 10.0
        if before - cost < LEAST_GAIN * before:
            break
    return x


def _cost(problem: WaterModel, x: Array, noise: float) -> float:
    """Soft L1 of the sightings' whitened errors and squares of the priors', together."""
    total = float((problem.priors(x)[0] ** 2).sum())
    for c in range(3):
        errors, J = problem.look(x, c)
        total += float(2.0 * (np.sqrt(1.0 + (errors / noise) ** 2) - 1.0).sum())
        dark = problem.darkest(J)
        total += 0.0 if dark is None else dark[1] ** 2
    return total


def _normal_equations(problem: WaterModel, x: Array, noise: float) -> tuple[Array, Array]:
    """J^T W J and J^T W r of the same cost, the weights those of soft L1."""
    residuals, rows = problem.priors(x)
    H, g = rows.T @ rows, rows.T @ residuals
    for c in range(3):
        own = problem.of_channel(c)
        errors, J = problem.look(x, c)
        by_error, by_J = problem.derivatives(x, c)
        weight = 1.0 / (noise**2 * np.sqrt(1.0 + (errors / noise) ** 2))
        H[np.ix_(own, own)] += (weight * by_error) @ by_error.T
        g[own] += by_error @ (weight * errors)
        dark = problem.darkest(J)
        if dark is not None:
            row = by_J[:, dark[0]] / DARK_SIGMA
            H[np.ix_(own, own)] += np.outer(row, row)
            g[own] += row * dark[1]
    return H, g


def _beta_a_sigma(fit: _Fit) -> list[float]:
    H, _ = _normal_equations(fit.problem, fit.x, fit.noise)
    variance = np.diag(np.linalg.pinv(H, hermitian=True))
    return list(np.sqrt(np.maximum(variance[:3], 0.0)).tolist())
