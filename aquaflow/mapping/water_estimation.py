"""The water, and the camera's shading, from surface points seen at several ranges.

A point's colour J is unknown but the same from everywhere; what changes with range is the water:
the contrast between bright and dark points decays by exp(-beta z), and their common level moves
towards B_inf. For trial parameters the best J of every point is linear, so it is eliminated
(variable projection) and three numbers per channel remain. Photometric gradients alone hardly move
them, because every Gaussian's colour can follow the water's error.

Lamps and lenses darken the picture towards its edge, and near ground is seen near the edge: left
out, that looks like water. The shading enters only where the sightings warrant its parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.shading import TERMS, shading_basis

Array = npt.NDArray[np.float64]

MIN_POINTS = 100
"""Fewer points seen at several ranges say nothing about the water."""
MIN_RANGE_RATIO = 1.25
"""Points whose largest range over smallest is below this carry no information."""
NOISE = 0.01
"""Least colour noise of one sighting."""
RATE_RATIO_SIGMA = 0.5
"""Prior: log of b over beta_a; both come from the same absorption and scattering."""
RATE_SIGMA = 1.5
"""Prior: log of beta_a around the start value, weak: a factor of 4.5 either way."""
B_INF_LOGIT, B_INF_SIGMA = -1.0, 1.5
"""Prior: logit of B_inf (0.27), weak."""
DARK_SHARE, DARK_LEVEL, DARK_SIGMA = 0.02, 0.02, 0.1
"""Prior: the darkest 2 % of the points are shadows, nearly black (dark channel, He et al. 2011)."""
SHADING_SIGMA = 0.3
"""Prior: log-gain at the edge of the picture; a third is a strong lamp fall-off."""
MAX_EVALUATIONS = 40


@dataclass(frozen=True)
class Observations:
    """Surface points in several pictures; one row per sighting."""

    point: npt.NDArray[np.int64]
    """[M] number of the point, 0 to P - 1."""
    colour: Array
    """[M, 3] as the camera saw it, at one and the same footprint per point."""
    z: Array
    """[M] range, map units."""
    xy: Array
    """[M, 2] where in the picture, each axis from -1 to 1."""

    @property
    def points(self) -> int:
        return int(self.point.max()) + 1 if len(self.point) else 0


@dataclass(frozen=True)
class WaterEstimate:
    """Each [3] RGB; rates per map unit."""

    beta_a: Array
    B_inf: Array
    b: Array
    beta_a_sigma: Array
    """Relative standard deviation of beta_a."""
    shading: Array
    """[5] coefficients of the log-gain; zeros where shading does not pay."""


def informative(observations: Observations) -> Observations:
    """Only the points that were seen at clearly different ranges, renumbered."""
    count = observations.points
    low, high = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(low, observations.point, observations.z)
    np.maximum.at(high, observations.point, observations.z)
    good = high > MIN_RANGE_RATIO * low
    keep = good[observations.point]
    number = np.cumsum(good) - 1
    return Observations(
        number[observations.point[keep]],
        observations.colour[keep],
        observations.z[keep],
        observations.xy[keep],
    )


def estimate_water(
    observations: Observations,
    B_res: Array,  # [3]
    d: Array,  # [3] 1 / map unit
    start_beta: float,
    shading: bool = True,
) -> WaterEstimate | None:
    """Fit beta_a, b, B_inf and, unless told not to, shading; None where too few points span a
    range."""
    seen = informative(observations)
    if seen.points < MIN_POINTS:
        return None
    plain = _Problem(seen, B_res, d, start_beta, shaded=False)
    start = np.concatenate([np.full(6, np.log(start_beta)), np.full(3, B_INF_LOGIT)])
    x, cost, noise = _solve(plain, start)
    if not shading:
        return _estimate(plain, x, noise)
    shaded = _Problem(seen, B_res, d, start_beta, shaded=True)
    x_shaded, cost_shaded, noise_shaded = _solve(shaded, np.append(x, np.zeros(TERMS)))
    if _pays(cost, cost_shaded, 3 * seen.points):
        return _estimate(shaded, x_shaded, noise_shaded)
    return _estimate(plain, x, noise)


def _pays(plain: float, shaded: float, values: int) -> bool:
    """Bayesian information criterion: does the lower cost warrant the additional parameters?

    ``values`` independent values, one per point and channel; costs are mean absolute errors.
    """
    gain = 2.0 * values * np.log(max(plain, 1e-12) / max(shaded, 1e-12))
    return bool(gain > TERMS * np.log(values))


def _solve(problem: _Problem, start: Array) -> tuple[Array, float, float]:
    """Parameters, mean absolute residual, and the noise that gives every point one vote.

    Sightings of one point share its errors, so they count together as one; a second fit weighs them
    against the priors by the noise that the first one found.
    """
    from scipy.optimize import least_squares

    sightings_per_point = len(problem.seen.z) / problem.seen.points
    first = least_squares(problem.residuals, start, loss="soft_l1", max_nfev=MAX_EVALUATIONS)
    spread = float(np.median(np.abs(problem.errors(first.x)))) / 0.6745
    noise = max(spread, NOISE) * np.sqrt(sightings_per_point)
    problem.noise = noise
    fit = least_squares(problem.residuals, first.x, loss="soft_l1", max_nfev=MAX_EVALUATIONS)
    return fit.x, float(np.abs(problem.errors(fit.x)).mean()), noise


def _estimate(problem: _Problem, x: Array, noise: float) -> WaterEstimate:
    problem.noise = noise
    step = 1e-5
    columns = [
        (problem.residuals(x + step * e) - problem.residuals(x - step * e)) / (2.0 * step)
        for e in np.eye(len(x))
    ]
    J = np.stack(columns, axis=1)
    variance = np.diag(np.linalg.pinv(J.T @ J, hermitian=True))
    shading = x[9:] if problem.shaded else np.zeros(TERMS)
    return WaterEstimate(
        np.exp(x[:3]), _sigmoid(x[6:9]), np.exp(x[3:6]), np.sqrt(np.maximum(variance[:3], 0.0)),
        shading,
    )  # fmt: skip


class _Problem:
    """Residuals in (log beta_a [3], log b [3], logit B_inf [3], shading [5])."""

    def __init__(
        self, seen: Observations, B_res: Array, d: Array, start_beta: float, shaded: bool
    ) -> None:
        self.seen, self.shaded, self.noise = seen, shaded, NOISE
        self._near = B_res * np.exp(-d * seen.z[:, None])
        self._start = np.log(start_beta)
        self._basis = shading_basis(seen.xy)

    def errors(self, x: Array) -> Array:
        """[M, 3] predicted minus seen colour, with the best J of every point."""
        return self._predict(x)[0]

    def residuals(self, x: Array) -> Array:
        """Whitened errors, then the priors."""
        errors, J = self._predict(x)
        log_beta, log_b, B_inf = x[:3], x[3:6], x[6:9]
        darkest = np.quantile(J, DARK_SHARE, axis=0)
        priors = [
            (log_b - log_beta) / RATE_RATIO_SIGMA,
            (log_beta - self._start) / RATE_SIGMA,
            (B_inf - B_INF_LOGIT) / B_INF_SIGMA,
            (darkest - DARK_LEVEL) / DARK_SIGMA,
            x[9:] / SHADING_SIGMA,
        ]
        return np.concatenate([errors.reshape(-1) / self.noise, *priors])

    def _predict(self, x: Array) -> tuple[Array, Array]:
        z, point = self.seen.z[:, None], self.seen.point
        gain = np.exp(self._basis @ x[9:])[:, None] if self.shaded else np.ones_like(z)
        T = gain * np.exp(-np.exp(x[:3]) * z)
        B = gain * (_sigmoid(x[6:9]) * -np.expm1(-np.exp(x[3:6]) * z) + self._near)
        top, bottom = T * (self.seen.colour - B), T * T
        count = self.seen.points
        J = np.stack(
            [
                np.bincount(point, top[:, c], count)
                / np.maximum(np.bincount(point, bottom[:, c], count), 1e-12)
                for c in range(3)
            ],
            axis=-1,
        )
        return T * np.maximum(J, 0.0)[point] + B - self.seen.colour, J


def _sigmoid(x: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-x)))
