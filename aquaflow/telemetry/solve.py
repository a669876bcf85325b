"""The state that all sources together make likeliest, and its covariance.

A few rounds of least squares. In the first ones single samples far from the others count less
(Cauchy's weights, noise by the median); then those beyond a chi-square gate are left out, each
source's noise is found from its own residuals, and the rest is generalised least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, solve_triangular

from aquaflow.optimise.least_squares import (
    Ending,
    NormalEquations,
    Rules,
    covariance_of,
    minimise,
)
from aquaflow.optimise.robust import Cauchy, sigma_of
from aquaflow.telemetry.factors import Factor
from aquaflow.telemetry.start import Noise
from aquaflow.telemetry.state import SCALE, MetricState, P
from aquaflow.telemetry.world_frame import Origin, SourceReport

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ROBUST_ROUNDS, ROUNDS = 3, 3
"""Rounds with Cauchy's weights, and with the noise found; more change nothing (measured)."""
RULES = Rules(iterations=12, sigmas=1e-4, damping=1e-9)
"""Of a round; three or four iterations are usual."""
KERNEL = Cauchy(2.4)
"""Of single samples; the likeliest noise is that of those that the gate leaves."""
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
    found, derivatives = _Estimate(start, np.zeros(P)), _Derivatives(factors)
    kept = tuple(np.ones(len(factor.t_s), dtype=bool) for factor in factors)
    for _ in range(ROBUST_ROUNDS):
        whitening = [_Robust(factor, factor.residuals(found.state)) for factor in factors]
        found = _descend(derivatives, whitening, found, prior)
    noise: tuple[Noise, ...] = ()
    correlated: list[_Correlated] = []
    for _ in range(ROUNDS):
        residuals = [factor.residuals(found.state) for factor in factors]
        kept = tuple(_gate(f, r) for f, r in zip(factors, residuals, strict=True))
        noise = tuple(
            f.possible_noise(k).likeliest(r[k])
            for f, r, k in zip(factors, residuals, kept, strict=True)
        )
        correlated = [_Correlated(*each) for each in zip(factors, kept, noise, strict=True)]
        found = _descend(derivatives, correlated, found, prior)
    information = []
    for derivative, whiten in zip(derivatives.at(found), correlated, strict=True):
        J = whiten(derivative)
        information.append(J.T @ J)
    total = np.diag(prior**-2.0) + np.sum(information, axis=0)
    covariance = covariance_of(total)
    if not np.isfinite(covariance).all():
        raise ArithmeticError("the fusion's covariance is not finite")
    for each in zip(factors, kept, information, strict=True):
        covariance[SCALE, SCALE] += dilution(total, *each) ** 2
    return Solution(found.state, covariance, kept, noise, tuple(information))


def dilution(
    total: Array,  # [P, P] information of all factors and the prior
    factor: Factor,
    kept: Mask,  # [N]
    information: Array,  # [P, P] of the factor
) -> float:
    """Relative 1 sigma by which a pressure depth may make the scale too small, since it is compared
    with the map's own rise and fall (regression dilution); 0 for other factors.

    Where a map drifts by more than a level vehicle rises, a scale too small fits best: by
    log(1 + N variance) if all that N residuals hold is the map's, by nothing if it is the sensor's.
    Nothing tells them apart, so half of it is one sigma. Simulated level dives of ten minutes,
    whose maps tilt by 0.02 to 0.2 degrees in each root of a second, had scales 1 to 37 % short
    where 1.8 to 5.2 % were stated, and 55 % where it was 7.9 % (2026-11-28).
    """
    if factor.kind != "depth":
        return 0.0
    known, without = (1.0 / covariance_of(each)[0, 0] for each in (total, total - information))
    own = known - without
    if own <= 0.0:
        return 0.0
    return float(0.5 * np.log1p(np.count_nonzero(kept) / own) * own / known)


@dataclass(frozen=True)
class _Estimate:
    """A state, and how far it is from the start of all rounds, around which the prior lies."""

    state: MetricState
    departure: Array
    """[P] sum of the steps, in the parameters' own units."""


class _Derivatives:
    """Of all factors' residuals, at a state next to the one asked for."""

    def __init__(self, factors: Sequence[Factor]) -> None:
        self.factors = factors
        self.information: Array = np.zeros((P, P))
        """[P, P] by which departures are measured."""
        self._found: list[Array] | None = None
        self._departure: Array = np.zeros(P)

    def at(self, estimate: _Estimate) -> list[Array]:
        """[N, D, P] of each factor."""
        apart = estimate.departure - self._departure
        if self._found is None or apart @ self.information @ apart > RELINEARISE**2:
            self._found = [factor.jacobian(estimate.state) for factor in self.factors]
            self._departure = estimate.departure
        return self._found


class _Robust:
    """Weights that single samples far from the rest cannot move."""

    def __init__(
        self,
        factor: Factor,
        r: Array,  # [N, D]
    ) -> None:
        size = np.linalg.norm(r, axis=1) / np.sqrt(r.shape[1])
        sigma = np.maximum(factor.sigma, sigma_of(size))
        self._weights = np.sqrt(KERNEL.weight(size / sigma)) / sigma

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


class _Posterior:
    """The whitened residuals of all factors, and what was known before."""

    def __init__(
        self,
        derivatives: _Derivatives,
        whitening: Sequence[Callable[[Array], Array]],
        prior: Array,  # [P]
    ) -> None:
        self._derivatives, self._whitening, self._prior = derivatives, whitening, prior

    def linearise(self, at: _Estimate) -> NormalEquations:
        """The equations of a step [P]."""
        total = NormalEquations.expect(at.departure, self._prior)
        derivatives, residuals = self._derivatives.at(at), self._residuals(at)
        for derivative, whiten, r in zip(derivatives, self._whitening, residuals, strict=True):
            total += NormalEquations.of(whiten(derivative), r)
        self._derivatives.information = total.H
        return total

    def cost(self, at: _Estimate) -> float:
        """Half the sum of all squares, sigmas."""
        total = float(((at.departure / self._prior) ** 2).sum())
        return 0.5 * (total + sum(float(r @ r) for r in self._residuals(at)))

    def move(
        self,
        at: _Estimate,
        step: Array,  # [P]
    ) -> _Estimate:
        """A step [P], shortened as a whole where it turns too far."""
        step = step * min(1.0, LONGEST_TURN / max(float(np.abs(step[:4]).max()), LONGEST_TURN))
        return _Estimate(at.state.move(step), at.departure + step)

    def _residuals(self, at: _Estimate) -> list[Array]:
        factors = self._derivatives.factors
        return [
            whiten(factor.residuals(at.state)[..., None])[:, 0]
            for factor, whiten in zip(factors, self._whitening, strict=True)
        ]


def _descend(
    derivatives: _Derivatives,
    whitening: Sequence[Callable[[Array], Array]],
    start: _Estimate,
    prior: Array,  # [P]
) -> _Estimate:
    found = minimise(_Posterior(derivatives, whitening, prior), start, RULES)
    if found.ending in {Ending.NOT_FINITE, Ending.SINGULAR}:
        raise ArithmeticError("the residuals of telemetry are not finite")
    return found.state


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
    spread = max(1.0, sigma_of(apart))
    return np.asarray(apart <= GATE * spread)


# --------------------------------------------------------------------------------------------------
# What the estimator solves: sources as factors, where to start, what is known before.

OPEN_M, FIXED = 1e4, 1e-3
"""1 sigma of what only telemetry can say (m), and of what is a convention where none does."""
ANY_TURN = np.pi
"""rad, 1 sigma of a turn that nothing is known of."""


@dataclass(frozen=True)
class Carried:
    """What an earlier sub-map of the dive has shown, for the next one."""

    state: MetricState
    """Mountings and the compass's constant error are the same."""
    heading_sigma: float
    """rad, 1 sigma of the compass's error against ``state``'s."""
    place: tuple[float, Array, Array] | None
    """Moment (s), north and east [2] m of the body by dead reckoning, covariance [2, 2] m^2."""
    origin: Origin | None
    true_north: bool
    """True if ``state``'s heading is the compass's error against true north."""


@dataclass
class TelemetryProblem:
    """One sub-map's sources as factors, the state to start from, and what is known before."""

    start: MetricState
    prior: Array
    """[P] 1 sigma of each parameter."""
    factors: list[Factor] = field(default_factory=list)
    reports: list[SourceReport] = field(default_factory=list)
    """Of sources that give no factor."""
    compass: bool = False
    """True if x of n is north."""
    declination_known: bool = False
    """True if the compass's north is the true one, but for its error."""
    level: bool = False
    """True if something measures down."""
    on_ground: bool = False
    """True if nothing but the ground's mean plane and fixes do."""
    mounted: bool = True
    """False if nothing is known of the camera's mounting."""
    origin: Origin | None = None
    doubt: str = ""
    """Why the scale is less sure than the factors say; empty where it is not."""
