"""The water, the camera's shading and the views' exposures, from points seen at several ranges.

A point's colour J is unknown but the same from everywhere; what changes with range is the water:
the contrast between bright and dark points decays by exp(-beta z), and their common level moves
towards B_inf. Photometric gradients alone hardly move the water, because every Gaussian's colour
can follow its error.

Lamps and lenses darken the picture towards its edge, and near ground is seen near the edge: left
out, that looks like water. So does light that changes while the vehicle climbs. Sunlit water shines
more brightly the less one looks down. And in air or clear water there is nothing to find at all.
Which of the four are there is chosen by the Bayesian information criterion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig, WaterPriorsConfig
from aquaflow.mapping.water.model import BELIEVED, NOISE, WaterModel
from aquaflow.mapping.water.observations import Observations, informative
from aquaflow.mapping.water.parameters import Model

Array = npt.NDArray[np.float64]

MIN_POINTS = 100
"""Fewer points seen at several ranges say nothing about the water."""
POINTS_PER_VALUE = 5.0
"""Neighbouring points share the map's errors, so that this many say what one could alone. Evidence
for water on a clear reef and clear sand with 10: -22 to -25, with 5: -21 to -27, with 2: -12 to
-28; on Curasao and IUI3 0 to 22, 10 to 60 and 47 to 190."""
WATER_IS_USUAL = 10.0
"""Log odds for water before anything is seen: a dive is in water until very strong evidence (5,
Kass and Raftery 1995), twice over, speaks against it."""
MAX_STEPS = 30
"""Limit of Levenberg-Marquardt in one fit."""
LEAST_GAIN = 1e-5
"""Relative fall of the cost at which a fit has converged."""
DAMPING = 1e-3, 1e6
"""Levenberg-Marquardt's first damping, and the one at which no step helps any more."""
EVERY_MODEL = (
    *(Model(*parts) for parts in product((False, True), repeat=3)),
    Model(water=True, uneven=True),
    Model(water=True, exposure=True, uneven=True),
)
"""With and without water, shading and changing exposure; and the unevenness of the backscatter,
which looks so much like shading that no dive tells of both."""


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
    unevenness: Array
    """[5] coefficients of the backscatter's log-gain over the picture."""
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
    """Mean absolute error of the observations."""
    noise: float

    @property
    def criterion(self) -> float:
        """Bayesian information criterion."""
        values = 3 * self.problem.seen.points / POINTS_PER_VALUE
        likelihood = -values * np.log(max(self.error, 1e-12))
        return float(self.problem.free * np.log(values) - 2.0 * likelihood)


def models_for(config: MediumConfig) -> list[Model]:
    """The models that the config allows."""
    water = {config.enabled, config.enabled and not config.off_when_clear}
    return [
        model
        for model in EVERY_MODEL
        if model.water in water
        and (config.shading or not model.shading)
        and (config.uneven or not model.uneven)
        and (config.exposure or not model.exposure)
    ]


def estimate_water(
    observations: Observations,
    B_res: Array,  # [3]
    d: Array,  # [3] 1 / map unit
    start_beta: float,
    models: Sequence[Model] = EVERY_MODEL,
    priors: WaterPriorsConfig = BELIEVED,
) -> WaterEstimate | None:
    """Fit ``models`` and keep the likeliest; None where too few points span a range."""
    seen = informative(observations)
    if seen.points < MIN_POINTS:
        return None
    fits: list[_Fit] = []
    for model in models:
        fits.append(_solve(WaterModel(seen, model, B_res, d, start_beta, priors), fits))
    best = min(fits, key=lambda fit: fit.criterion - 2.0 * WATER_IS_USUAL * fit.problem.model.water)
    trial = best.problem.trial(best.x)
    return WaterEstimate(
        best.problem.model,
        trial.beta_a,
        trial.B_inf,
        trial.b,
        trial.unevenness,
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


def _descend(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> Array:
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


def _cost(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> float:
    """Soft L1 of the sightings' whitened errors and squares of the priors', together."""
    total = float((problem.priors(x)[0] ** 2).sum())
    looks = [problem.look(x, c) for c in range(3)]
    for errors, _ in looks:
        total += float(2.0 * (np.sqrt(1.0 + (errors / noise) ** 2) - 1.0).sum())
    colours = np.stack([J for _, J in looks])
    return total + sum(belief.residual**2 for belief in problem.beliefs(colours))


def _normal_equations(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> tuple[Array, Array]:
    """J^T W J and J^T W r of the same cost, the weights those of soft L1."""
    residuals, rows = problem.priors(x)
    H, g = rows.T @ rows, rows.T @ residuals
    colours, colours_change = [], []
    for c in range(3):
        own = problem.of_channel(c)
        errors, J = problem.look(x, c)
        by_error, by_J = problem.derivatives(x, c)
        weight = 1.0 / (noise**2 * np.sqrt(1.0 + (errors / noise) ** 2))
        H[np.ix_(own, own)] += (weight * by_error) @ by_error.T
        g[own] += by_error @ (weight * errors)
        colours.append(J)
        colours_change.append((own, by_J))
    for belief in problem.beliefs(np.stack(colours)):
        row = np.zeros(problem.size)
        for c, slope in belief.by_J.items():
            own, by_J = colours_change[c]
            row[own] += by_J @ slope
        H += np.outer(row, row)
        g += row * belief.residual
    return H, g


def _beta_a_sigma(fit: _Fit) -> list[float]:
    H, _ = _normal_equations(fit.problem, fit.x, fit.noise)
    variance = np.diag(np.linalg.pinv(H, hermitian=True))
    return list(np.sqrt(np.maximum(variance[:3], 0.0)).tolist())
