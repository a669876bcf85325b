"""What sightings of surface points look like through trial water, and how that changes with it.

A sighting of point p in view v is ``gain_v shade(x, y) ((J_p + blend) T + B)``. The best J of every
point is linear, so it is eliminated (variable projection); what remains are nine numbers for the
water, five for the shading and three for every view's exposure, each group only where a ``Model``
has it. The derivatives follow Kaufman: those of the model, less what a change of J would undo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.shading import TERMS, shading_basis
from aquaflow.mapping.sighted_points import Observations

Array = npt.NDArray[np.float64]

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
EXPOSURE_SIGMA = 0.5
"""Prior: log-gain of a view against the mean of all; two stops span a dive's auto-exposure."""
WATER = 9
"""log beta_a, log b and logit B_inf, RGB each."""
MAX_LOG_RATE = 5.0
"""Guards the exponential; such water is black at a hundredth of a map unit."""
MAX_LOGIT = 10.0
"""Guards the exponential; B_inf is black or white to 0.005 %."""
MAX_LOG_GAIN = 2.0
"""Guards the exponential of shading and exposure."""
TINY = 1e-12
"""Guards the division by the light that arrives of a point."""


@dataclass(frozen=True)
class Model:
    """What may lie between a point's colour and the picture's."""

    water: bool = False
    shading: bool = False
    exposure: bool = False


@dataclass(frozen=True)
class Trial:
    """Parameters as what they stand for; those that the model lacks have no effect."""

    beta_a: Array
    """[3] per map unit."""
    b: Array
    """[3] per map unit."""
    B_inf: Array
    """[3]"""
    shading: Array
    """[5] log-gain over the picture."""
    exposure: Array
    """[V, 3] log-gain of each view, of mean zero: no sighting tells brighter points from brighter
    views."""


class WaterModel:
    """Errors, priors and their derivatives for one ``Model`` of the same sightings.

    The parameters lie in one vector: log beta_a, log b, logit B_inf, shading, exposures.
    """

    def __init__(
        self,
        seen: Observations,
        model: Model,
        B_res: Array,  # [3]
        d: Array,  # [3] 1 / map unit
        start_beta: float,
    ) -> None:
        self.seen, self.model = seen, model
        self.views = int(seen.view.max()) + 1
        self._near = B_res * np.exp(-d * seen.z[:, None])
        self._basis = shading_basis(seen.xy)
        self._cell = seen.point * self.views + seen.view
        sizes = (WATER * model.water, TERMS * model.shading, 3 * self.views * model.exposure)
        _, self._shading, self._exposure, self.size = np.cumsum((0, *sizes)).tolist()
        self.start, self.sigma = np.zeros(self.size), np.empty(self.size)
        if model.water:
            self.start[:WATER] = [np.log(start_beta)] * 6 + [B_INF_LOGIT] * 3
            self.sigma[:WATER] = [RATE_SIGMA] * 3 + [RATE_RATIO_SIGMA] * 3 + [B_INF_SIGMA] * 3
        self.sigma[self._shading : self._exposure] = SHADING_SIGMA
        self.sigma[self._exposure :] = EXPOSURE_SIGMA

    @property
    def free(self) -> int:
        """Parameters that the sightings choose; the mean exposure is none of them."""
        return int(self.size) - 3 * self.model.exposure

    def adopt(self, other: WaterModel, x: Array) -> Array:
        """The start, with the parameters of ``other``'s fit where both models have them."""
        adopted = self.start.copy()
        for mine, theirs in zip(self._parts(), other._parts(), strict=True):
            if mine.stop - mine.start == theirs.stop - theirs.start:
                adopted[mine] = x[theirs]
        return adopted

    def _parts(self) -> tuple[slice, slice, slice]:
        return (
            slice(0, self._shading),
            slice(self._shading, self._exposure),
            slice(self._exposure, self.size),
        )

    def of_channel(self, c: int) -> npt.NDArray[np.int64]:
        """Where in the vector the parameters lie that channel ``c`` depends on."""
        water = [c, 3 + c, 6 + c] if self.model.water else []
        shading = range(self._shading, self._exposure)
        return np.array([*water, *shading, *range(self._exposure + c, self.size, 3)], np.int64)

    def trial(self, x: Array) -> Trial:
        """What the parameters stand for."""
        wet, model = np.zeros((3, 3)), self.model
        if model.water:
            wet[:2] = np.exp(np.clip(x[:6], -MAX_LOG_RATE, MAX_LOG_RATE)).reshape(2, 3)
            wet[2] = 1.0 / (1.0 + np.exp(-np.clip(x[6:WATER], -MAX_LOGIT, MAX_LOGIT)))
        shading = x[self._shading : self._exposure] if model.shading else np.zeros(TERMS)
        exposure = x[self._exposure :] if model.exposure else np.zeros(3 * self.views)
        exposure = exposure.reshape(self.views, 3)
        return Trial(wet[0], wet[1], wet[2], shading, exposure - exposure.mean(axis=0))

    def look(self, x: Array, c: int) -> tuple[Array, Array]:
        """Errors [M] of one channel, predicted minus seen, and the best J [P] of every point."""
        predicted, J, _ = self._predict(self.trial(x), c)
        return predicted - self.seen.colour[:, c], J

    def derivatives(self, x: Array, c: int) -> tuple[Array, Array]:
        """Of :meth:`look`'s errors [K, M] and J [K, P] by the parameters ``of_channel(c)``."""
        trial, seen, points = self.trial(x), self.seen, self.seen.points
        predicted, J, a = self._predict(trial, c)
        power = np.maximum(np.bincount(seen.point, a * a, points), TINY)
        direct: list[Array] = []
        if self.model.water:
            gain, passed = self._gain(trial, c), np.exp(-trial.b[c] * seen.z)
            B_inf, beta_z, b_z = trial.B_inf[c], trial.beta_a[c] * seen.z, trial.b[c] * seen.z
            direct += [
                -a * (J[seen.point] + seen.blend[:, c]) * beta_z,
                gain * B_inf * b_z * passed,
            ]
            direct += [gain * B_inf * (1.0 - B_inf) * (1.0 - passed)]
        if self.model.shading:
            direct += list(predicted * self._basis.T)
        by_J = [-np.bincount(seen.point, a * change, points) / power for change in direct]
        if self.model.exposure:
            # A view's gain touches its own sightings alone, and what is left of it the mean's.
            sums = np.bincount(self._cell, a * predicted, points * self.views)
            of_gains = -sums.reshape(points, self.views).T / power
            by_J += list(of_gains - of_gains.mean(axis=0))
            own = np.full((self.views, len(a)), -predicted / self.views)
            own[seen.view, np.arange(len(a))] += predicted
            direct += list(own)
        changes = np.stack(by_J) if by_J else np.zeros((0, points))
        through_J = a * changes[:, seen.point]
        return (np.stack(direct) + through_J if direct else through_J), changes

    def priors(self, x: Array) -> tuple[Array, Array]:
        """Whitened residuals [K] of the linear priors, and their derivatives [K, K]."""
        rows = np.diag(1.0 / self.sigma)
        residuals = (x - self.start) / self.sigma
        if self.model.water:
            rates = np.arange(3)
            rows[3 + rates, rates] = -1.0 / RATE_RATIO_SIGMA
            residuals[3:6] = (x[3:6] - x[:3]) / RATE_RATIO_SIGMA
        return residuals, rows

    def darkest(self, J: Array) -> tuple[int, float] | None:
        """The point that stands for the shadows, and how far from black it is, whitened."""
        if not self.model.water:
            return None
        rank = int(DARK_SHARE * (len(J) - 1))
        point = int(np.argpartition(J, rank)[rank])
        return point, float((J[point] - DARK_LEVEL) / DARK_SIGMA)

    def _predict(self, trial: Trial, c: int) -> tuple[Array, Array, Array]:
        """Predicted colours [M], J [P] (no point is darker than black), and J's factor [M]."""
        seen, gain = self.seen, self._gain(trial, c)
        a = gain * np.exp(-trial.beta_a[c] * seen.z)
        veil = np.zeros_like(a)
        if self.model.water:
            grown = -np.expm1(-trial.b[c] * seen.z)
            veil = gain * (trial.B_inf[c] * grown + self._near[:, c])
        beside = a * seen.blend[:, c] + veil
        top = np.bincount(seen.point, a * (seen.colour[:, c] - beside), seen.points)
        bottom = np.maximum(np.bincount(seen.point, a * a, seen.points), TINY)
        J = np.maximum(top / bottom, 0.0)
        return a * J[seen.point] + beside, J, a

    def _gain(self, trial: Trial, c: int) -> Array:
        log_gain = trial.exposure[self.seen.view, c] + self._basis @ trial.shading
        return np.asarray(np.exp(np.clip(log_gain, -MAX_LOG_GAIN, MAX_LOG_GAIN)))
