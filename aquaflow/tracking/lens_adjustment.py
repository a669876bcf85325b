"""Self-calibrating bundle adjustment: poses, inverse depths, and one error of the lens for all.

Every point belongs to the view that it was sampled in, so that the points' block of the normal
equations is diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.optics import TERMS
from aquaflow.optimise.least_squares import Rules, minimise
from aquaflow.optimise.robust import sigma_of_lengths
from aquaflow.tracking.lens_equations import (
    Array,
    Indices,
    LensEquations,
    LensObservations,
    LensUnknowns,
    SelfCalibration,
    Weighting,
    residuals,
    triangulate,
)

ROUNDS = 4
"""Of weighting: in the first the lens is held, in the last two outliers are left out."""
RULES = Rules(iterations=40, decrease=1e-6, growth=4.0, shrinkage=0.25)
"""Of each round; from a focal length 30 % off it takes about ten iterations. Where the lens is
badly known, the cost, some ten thousand, is flat. With damping that changes tenfold, every other
step along the narrow valley in which focal length and poses compensate each other fails
(measured)."""
OUTLIER_SIGMAS = 6.0
"""Mismatches of keypoints lie tens of standard deviations off; the error of a lens does not."""
MIN_SIGMA = 1e-6
"""Normalised units; noise below a thousandth of a pixel is a test without any."""


@dataclass(frozen=True)
class LensAdjustment:
    """The solution and its uncertainty."""

    adjusted: LensUnknowns
    covariance: Array
    """[2, 2] of u and k, from the scatter between the views: matches of one view share errors."""
    sigma_held: float
    """Noise of the matches, normalised units, that the calibration as it is leaves."""
    sigma: float
    """Noise of the matches with u and k solved for."""


def adjust_lens(
    observations: LensObservations,
    R_wc: Array,  # [V, 3, 3]
    centres: Array,  # [V, 3]
    terms: int,
    start: Array | None = None,  # [5] lens error, 0 if None
) -> LensAdjustment:
    """The first ``terms`` of the lens error that fit ``observations`` best; the others stay as in
    ``start``, with which the poses go.

    Raises:
        numpy.linalg.LinAlgError: the matches determine nothing at all.
    """
    lens = np.zeros(TERMS) if start is None else start
    state = LensUnknowns(R_wc, centres, np.ones(len(observations.points)), lens)
    sigmas: list[float] = []
    weighting = Weighting(1.0, np.zeros(0, dtype=bool))
    for number in range(ROUNDS):
        state = replace(state, rho=triangulate(observations, state))
        size = np.linalg.norm(residuals(observations, state), axis=-1)
        ahead = state.rho[observations.point] > 0.0
        sigma = _sigma(size[ahead])
        used = ahead if number < ROUNDS - 2 else ahead & (size < OUTLIER_SIGMAS * sigma)
        weighting = Weighting(sigma, used)
        problem = SelfCalibration(observations, weighting, terms if number else 0)
        state = minimise(problem, state, RULES).state
        sigmas.append(_sigma(np.linalg.norm(residuals(observations, state), axis=-1)[used]))
    covariance = _covariance(observations, state, weighting, terms)
    return LensAdjustment(state, covariance, sigmas[0], sigmas[-1])


def _covariance(
    observations: LensObservations, state: LensUnknowns, weighting: Weighting, terms: int
) -> Array:
    """[2, 2] of the lens: the sandwich estimator over the clusters of the points."""
    clusters = clusters_of(observations)
    count = len(np.unique(clusters))
    equations = LensEquations(observations, state, weighting, terms)
    H = equations.hessian
    free = slice(0, len(H) - TERMS + terms)
    inverse: Array = np.asarray(
        np.linalg.inv(equations.hold_gauge(H)[free, free]), dtype=np.float64
    )
    scatter = np.zeros_like(inverse)
    for cluster in np.unique(clusters):
        gradient = equations.gradient_of(clusters == cluster)
        scatter += np.outer(gradient[free], gradient[free]) * count / (count - 1.0)
    lens = slice(len(inverse) - terms, len(inverse) - terms + 2)
    sandwich = (inverse @ scatter @ inverse)[lens, lens]
    # Few clusters may agree by chance better than the noise of their matches lets them.
    return _larger(sandwich, inverse[lens, lens])


def model_error(simple: LensAdjustment, full: LensAdjustment) -> Array:
    """[2, 2] Of a lens of two terms: where more terms explain part of the noise, that part of the
    estimates' difference is a matter of the model and not of the calibration."""
    explained = max(0.0, 1.0 - (full.sigma / simple.sigma) ** 2)
    difference = full.adjusted.lens[:2] - simple.adjusted.lens[:2]
    return np.diag(explained * difference**2)


def clusters_of(observations: LensObservations) -> Indices:
    """[P] number of the view and quarter of the picture that each point was sampled in."""
    right, lower = (observations.points > 0.0).T
    return np.asarray(4 * observations.reference + 2 * lower + right, dtype=np.int64)


def _larger(
    a: Array,  # [2, 2]
    b: Array,  # [2, 2]
) -> Array:
    """[2, 2] a covariance that is nowhere smaller than either."""
    root = np.linalg.cholesky(b)
    whitened = np.linalg.solve(root, np.linalg.solve(root, a).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    return np.asarray(root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root.T)


def _sigma(
    size: Array,  # [M] lengths of residuals, normalised plane
) -> float:
    return max(sigma_of_lengths(size), MIN_SIGMA)
