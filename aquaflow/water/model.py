"""What sightings of surface points look like through trial water, and how that changes with it.

An observation of point p in view v is ``gain_v shade(x, y) (J_p T(z) + uneven(x, y) B(z))`` (paper,
Eq. 12). The best J of every point is linear, so it is eliminated (variable projection); what
remains lies in one vector (parameters.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.config import WaterPriorsConfig
from aquaflow.water.observations import Observations, RegionalColours
from aquaflow.water.parameters import Model, Trial, WaterUnknowns, shading_basis

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

BELIEVED = WaterPriorsConfig()
"""The priors that pay."""
MAX_LOG_GAIN = 2.0
"""Guards the exponential of shading, exposure and unevenness."""
TINY = 1e-12
"""Guards the division by the light that arrives of a point."""


@dataclass(frozen=True)
class Prediction:
    """All observations through one trial water."""

    trial: Trial
    gain: Array
    """[3, M] of view and shading."""
    a: Array
    """[3, M] share of a point's colour J that is observed."""
    backscatter: Array
    """[3, M] as observed."""
    J: Array
    """[3, P] the points' colours without water that fit best; none is darker than black."""
    errors: Array
    """[3, M] predicted minus seen."""
    power: Array
    """[3, P] weighted sums of a^2."""


@dataclass(frozen=True)
class Derivatives:
    """One channel's, by the parameters ``of_channel``: first those but exposures, k of them, then
    each view's own gain."""

    own: Index
    """[k + V]"""
    direct: Array
    """[k, M] of the errors, every J held."""
    lit: Array
    """[M] of an observation's error by the gain of its view."""
    by_J: Array
    """[k + V, P] of the J; 0 where J is held at black."""


class WaterModel(WaterUnknowns):
    """Errors and their derivatives for one ``Model`` of the same sightings."""

    def __init__(
        self,
        seen: Observations,
        model: Model,
        B_res: Array,  # [3]
        d: Array,  # [3] 1 / map unit
        priors: WaterPriorsConfig = BELIEVED,
    ) -> None:
        super().__init__(model, int(seen.view.max()) + 1, seen.median_range)
        self.seen, self.believed = seen, priors
        self._regions = RegionalColours(seen.region)
        self._B_res, self._d = B_res, d
        self._near = B_res[:, None] * np.exp(-d[:, None] * seen.z)
        self._basis = np.ascontiguousarray(shading_basis(seen.xy).T)
        self._colour = np.ascontiguousarray(seen.colour.T)

    def predict(
        self,
        x: Array,  # [K] parameters
        weight: Array | None = None,  # [3, M] of the observations; None: all alike
    ) -> Prediction:
        """The observations, with the J that fit them best at these weights."""
        trial, seen = self.trial(x), self.seen
        gain = _gain(trial.exposure.T[:, seen.view] + trial.shading @ self._basis)
        a = gain * np.exp(-trial.beta_a[:, None] * seen.z)
        backscatter = gain * self._backscatter(trial, seen.z, self._basis, self._near)
        weighed = a if weight is None else weight * a
        own = self._colour - backscatter
        power = np.maximum(seen.sums_by_point(weighed * a), TINY)
        J = np.maximum(seen.sums_by_point(weighed * own) / power, 0.0)
        return Prediction(trial, gain, a, backscatter, J, a * J[:, seen.point] - own, power)

    def without_water(
        self,
        trial: Trial,
        view: Index,  # [N]
        xy: Array,  # [N, 2] each axis from -1 to 1
        z: Array,  # [N] map units
        colour: Array,  # [N, 3] as the camera saw it
    ) -> Array:
        """[3, N] any pixels of the views without what lies between."""
        basis = np.ascontiguousarray(shading_basis(xy).T)
        lit = colour.T / _gain(trial.exposure.T[:, view] + trial.shading @ basis)
        near = self._B_res[:, None] * np.exp(-self._d[:, None] * z)
        veil = self._backscatter(trial, z, basis, near)
        T = np.maximum(np.exp(-trial.beta_a[:, None] * z), TINY)
        return np.maximum((lit - veil) / T, 0.0)

    def _backscatter(
        self,
        trial: Trial,
        z: Array,  # [N]
        basis: Array,  # [5, N]
        near: Array,  # [3, N] its residual close by
    ) -> Array:
        """[3, N] before the camera's gain."""
        if not self.model.water:
            return np.zeros_like(near)
        grown = -np.expm1(-trial.b[:, None] * z)
        return np.asarray(_gain(trial.unevenness @ basis) * (trial.B_inf[:, None] * grown + near))

    def derivatives(
        self,
        now: Prediction,
        weight: Array,  # [M] of the channel, that its J were found with
        c: int,
    ) -> Derivatives:
        """Of :meth:`predict`'s errors and J, the weights held."""
        seen, a, trial = self.seen, now.a[c], now.trial
        light = a * now.J[c, seen.point]
        lit = light + now.backscatter[c]
        direct: list[Array] = []
        if self.model.water:
            beta_a, b, B_inf = trial.beta_a[c], trial.b[c], trial.B_inf[c]
            water_gain = now.gain[c] * _gain(trial.unevenness @ self._basis)
            passed = np.exp(-b * seen.z)
            direct += [-beta_a * seen.z * light, water_gain * B_inf * b * seen.z * passed]
            direct += [water_gain * B_inf * (1.0 - B_inf) * (1.0 - passed)]
        if self.model.uneven:
            direct += list(now.backscatter[c] * self._basis)
        if self.model.shading:
            direct += list(lit * self._basis)
        rows = np.stack(direct) if direct else np.zeros((0, len(seen.z)))
        by_J = seen.sums_by_point(weight * a * rows) if len(rows) else np.zeros((0, seen.points))
        if self.model.exposure:
            # A view's gain touches its own sightings alone, and what is left of it the mean's.
            of_gains = np.zeros((self.views, seen.points))
            of_gains[seen.view, seen.point] = weight * a * lit
            by_J = np.vstack([by_J, of_gains - of_gains.mean(axis=0)])
        # dJ = -(sum w a d(errors)) / sum w a^2; no point is darker than black.
        by_J *= np.where(now.J[c] > 0.0, -1.0 / now.power[c], 0.0)
        return Derivatives(self.of_channel(c), rows, lit, by_J)

    def of_scene(
        self,
        J: Array,  # [3, P]
    ) -> Array:
        """[R] how far the points' colours are from what scenes without water have, whitened."""
        J = J[:, : self.seen.surface]
        single = [belief.residual for belief in beliefs(J, self.believed)]
        if not self.believed.regions:
            return np.array(single)
        return np.concatenate([single, self._regions.residuals(J)])

    def of_scene_rows(
        self,
        J: Array,  # [3, P]
        changes: list[tuple[Index, Array]],  # by channel: own [k], by_J [k, P]
    ) -> Array:
        """[R, K] derivatives of :meth:`of_scene`."""
        J = J[:, : self.seen.surface]
        changes = [(own, by_J[:, : self.seen.surface]) for own, by_J in changes]
        single = np.zeros((0, self.size))
        for belief in beliefs(J, self.believed):
            row = np.zeros((1, self.size))
            for c, slope in belief.by_J.items():
                own, by_J = changes[c]
                row[0, own] += by_J @ slope
            single = np.vstack([single, row])
        if not self.believed.regions:
            return single
        return np.vstack([single, self._regions.rows(J, changes, self.size)])


def _gain(
    log_gain: Array,  # [...]
) -> Array:
    return np.asarray(np.exp(np.clip(log_gain, -MAX_LOG_GAIN, MAX_LOG_GAIN)))


# --------------------------------------------------------------------------------------------------
# Weak priors on the colours of surface points without water.

DARK_SHARE, DARK_LEVEL, DARK_SIGMA = 0.02, 0.02, 0.2
"""The darkest 2 % of the points are shadows, nearly black (dark channel, He et al. 2011). Weak, as
sand has none: beta_a of six known waters is 9 % wrong with a sigma of 0.1, 7 % with 0.2 and 0.5."""
BRIGHT_SHARE, BRIGHT_LEVEL, BRIGHT_SIGMA = 0.02, 1.0, 0.2
"""Only the brightest 2 % of the points may be brighter than the camera's white (saturation)."""


@dataclass(frozen=True)
class Belief:
    """How far the points' colours are from what is usual, whitened."""

    residual: float
    by_J: dict[int, Array] = field(default_factory=dict)
    """Derivative [P] by the points' J, of the channels that it depends on."""


def beliefs(
    J: Array,  # [3, P]
    config: WaterPriorsConfig,
) -> list[Belief]:
    """All that are switched on."""
    found: list[Belief] = []
    for c in range(3):
        if config.dark_channel:
            found.append(_rank(J, c, DARK_SHARE, DARK_LEVEL, DARK_SIGMA))
        if config.saturation:
            bright = _rank(J, c, 1.0 - BRIGHT_SHARE, BRIGHT_LEVEL, BRIGHT_SIGMA)
            found += [bright] if bright.residual > 0.0 else []
    return found


def _rank(
    J: Array,  # [3, P]
    c: int,
    share: float,
    level: float,
    sigma: float,
) -> Belief:
    """The point with ``share`` of the others below it, against the level that it should have."""
    rank = int(share * (J.shape[1] - 1))
    point = int(np.argpartition(J[c], rank)[rank])
    by_J = np.zeros(J.shape[1])
    by_J[point] = 1.0 / sigma
    return Belief(float((J[c, point] - level) / sigma), {c: by_J})
