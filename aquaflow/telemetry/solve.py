"""The state that all sources together make likeliest, and its covariance.

Gauss-Newton with damping over a few rounds. In the first rounds single samples far from the others
count less (Cauchy's weights, noise by the median); then those beyond a chi-square gate are left
out, each source's noise is found from its own residuals, and the rest is generalised least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_solve, cholesky, solve_triangular

from aquaflow.geometry.robust import MAD_TO_SIGMA
from aquaflow.telemetry.factors.factor import Factor
from aquaflow.telemetry.noise import Noise, likeliest
from aquaflow.telemetry.state import MetricState, P

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ROBUST_ROUNDS, ROUNDS = 3, 3
"""Rounds with Cauchy's weights, and with the noise found; more change nothing (measured)."""
STEPS = 12
"""Most steps of a round; three or four are usual."""
SETTLED = 1e-4
"""Length of a step in sigmas at which a round ends."""
CAUCHY = 2.4
"""Sigmas at which Cauchy's weight is a half."""
GATE = 4.0
"""Sigmas: of ten thousand normal samples one lies beyond."""
RELINEARISE = 0.05
"""Sigmas that the state may move until derivatives are found anew. They are most of the work, and
the residuals decide where a round ends: a scale differs by 1e-5 of its sigma (measured)."""
LONGEST_TURN = 0.5
"""rad and log-scale of one step; a longer one is shortened as a whole."""


@dataclass(frozen=True)
class Solution:
    """The likeliest state."""

    state: MetricState
    covariance: Array
    """[P, P] of a step from ``state``."""
    kept: tuple[Mask, ...]
    """[N] of each factor: samples within the gate."""
    noise: tuple[Noise, ...]
    """Of each factor."""
    information: tuple[Array, ...]
    """[P, P] that each factor gives."""


def solve(
    factors: Sequence[Factor],
    start: MetricState,
    prior: Array,  # [P] 1 sigma of each parameter around ``start``
) -> Solution:
    """Solve from ``start``; parameters that no factor measures keep their prior.

    Raises:
        ArithmeticError: the residuals are not finite.
    """
    state, departed, derivatives = start, np.zeros(P), _Derivatives(factors)
    kept = tuple(np.ones(len(factor.t_s), dtype=bool) for factor in factors)
    for _ in range(ROBUST_ROUNDS):
        whitening = [_Robust(factor, factor.residuals(state)) for factor in factors]
        state, departed, _ = _descend(derivatives, whitening, state, departed, prior)
    noise: tuple[Noise, ...] = ()
    correlated: list[_Correlated] = []
    covariance = np.diag(prior**2)
    for _ in range(ROUNDS):
        residuals = [factor.residuals(state) for factor in factors]
        kept = tuple(_gate(f, r) for f, r in zip(factors, residuals, strict=True))
        noise = tuple(
            likeliest(f.t_s[k], r[k], f.sigma[k], f.slow)
            for f, r, k in zip(factors, residuals, kept, strict=True)
        )
        correlated = [_Correlated(*each) for each in zip(factors, kept, noise, strict=True)]
        state, departed, covariance = _descend(derivatives, correlated, state, departed, prior)
    if not np.isfinite(covariance).all():
        raise ArithmeticError("the fusion's covariance is not finite")
    information = []
    for derivative, whiten in zip(derivatives.at(state), correlated, strict=True):
        J = whiten(derivative)
        information.append(J.T @ J)
    return Solution(state, covariance, kept, noise, tuple(information))


class _Derivatives:
    """Of all factors' residuals, at a state next to the one asked for."""

    def __init__(self, factors: Sequence[Factor]) -> None:
        self.factors = factors
        self._found: list[Array] = []
        self._moved = np.inf

    def at(self, state: MetricState) -> list[Array]:
        """[N, D, P] of each factor."""
        if self._moved > RELINEARISE:
            self._found, self._moved = [factor.jacobian(state) for factor in self.factors], 0.0
        return self._found

    def note_move(self, sigmas: float) -> None:
        """The state has moved so far."""
        self._moved += sigmas


class _Robust:
    """Weights that single samples far from the rest cannot move."""

    def __init__(
        self,
        factor: Factor,
        r: Array,  # [N, D]
    ) -> None:
        size = np.linalg.norm(r, axis=1) / np.sqrt(r.shape[1])
        sigma = np.maximum(factor.sigma, MAD_TO_SIGMA * np.median(size) if len(size) else 0.0)
        self._weights = 1.0 / (sigma * np.sqrt(1.0 + (size / (CAUCHY * sigma)) ** 2))

    def __call__(
        self,
        values: Array,  # [N, D, K]
    ) -> Array:
        """[N D, K] in sigmas."""
        return np.asarray((values * self._weights[:, None, None]).reshape(-1, values.shape[2]))


class _Correlated:
    """Whitening by the covariance of the samples kept."""

    def __init__(
        self,
        factor: Factor,
        kept: Mask,  # [N]
        noise: Noise,
    ) -> None:
        self._kept = kept
        covariance = noise.covariance(factor.t_s[kept], factor.sigma[kept], factor.slow)
        self._root = cholesky(covariance, lower=True)

    def __call__(
        self,
        values: Array,  # [N, D, K]
    ) -> Array:
        """[n D, K] in sigmas, independent of each other."""
        flat = values[self._kept].reshape(len(self._root), -1)
        white = solve_triangular(self._root, flat, lower=True)
        return np.asarray(white.reshape(-1, values.shape[2]))


def _descend(
    derivatives: _Derivatives,
    whitening: Sequence[Callable[[Array], Array]],
    state: MetricState,
    departed: Array,  # [P] from the start, in the parameters' own units
    prior: Array,  # [P]
) -> tuple[MetricState, Array, Array]:
    """The state at the least cost, how far it went from the start, and the covariance there."""

    factors = derivatives.factors

    def cost(at: MetricState, away: Array) -> float:
        parts = (w(f.residuals(at)[..., None]) for f, w in zip(factors, whitening, strict=True))
        return float(sum((part**2).sum() for part in parts) + ((away / prior) ** 2).sum())

    damping, best = 1e-9, cost(state, departed)
    if not np.isfinite(best):
        raise ArithmeticError("the residuals of telemetry are not finite")
    for _ in range(STEPS):
        A, b = np.diag(prior**-2.0), -departed / prior**2
        for factor, derivative, whiten in zip(
            factors, derivatives.at(state), whitening, strict=True
        ):
            J = whiten(derivative)
            r = whiten(factor.residuals(state)[..., None])[:, 0]
            A, b = A + J.T @ J, b - J.T @ r
        step = _step(A, b, damping)
        step *= min(1.0, LONGEST_TURN / max(float(np.abs(step[:4]).max()), LONGEST_TURN))
        trial, away = state.move(step), departed + step
        after = cost(trial, away)
        if not after <= best * (1.0 + 1e-12):
            damping = 10.0 * max(damping, 1e-6)
            continue
        state, departed, best, damping = trial, away, after, 0.1 * damping
        length = float(np.sqrt(step @ A @ step))
        derivatives.note_move(length)
        if length < SETTLED:
            break
    return state, departed, inverse_of(A)


def _step(
    A: Array,  # [P, P] positive definite
    b: Array,  # [P]
    damping: float,
) -> Array:
    root = 1.0 / np.sqrt(np.diag(A))
    scaled = A * np.outer(root, root) + damping * np.eye(P)
    return np.asarray(root * cho_solve((cholesky(scaled, lower=True), True), root * b))


def inverse_of(
    A: Array,  # [P, P] positive definite
) -> Array:
    """[P, P] inverse, by way of a unit diagonal: entries differ by many orders of magnitude."""
    root = 1.0 / np.sqrt(np.diag(A))
    scaled = cholesky(A * np.outer(root, root), lower=True)
    return np.asarray(np.outer(root, root) * cho_solve((scaled, True), np.eye(P)))


def _gate(
    factor: Factor,
    r: Array,  # [N, D]
) -> Mask:
    """[N] samples that lie with their neighbours in time.

    What varies slowly is no outlier; so each is compared with the median of those around it.
    """
    from scipy.ndimage import median_filter

    width = min(9, 2 * (len(r) // 2) + 1)
    apart = np.linalg.norm(r - median_filter(r, size=(width, 1), mode="nearest"), axis=1)
    apart /= factor.sigma * np.sqrt(r.shape[1])
    spread = max(1.0, MAD_TO_SIGMA * float(np.median(apart))) if len(r) else 1.0
    return np.asarray(apart <= GATE * spread)
