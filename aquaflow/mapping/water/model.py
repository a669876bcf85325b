"""What sightings of surface points look like through trial water, and how that changes with it.

An observation of point p in view v is ``gain_v shade(x, y) (J_p T + trust blend T / T_p +
uneven(x, y) B)``, with T_p the transmission at the point's mean range, drawn towards its
surroundings (blur.py). The best J of every point is linear, so it is eliminated (variable
projection); what remains lies in one vector (parameters.py). The derivatives are exact: the cost
is robust, so that those of Kaufman, which leave out how J's factor changes, point in a wrong
direction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.config import WaterPriorsConfig
from aquaflow.mapping.water.grouping import mean_by
from aquaflow.mapping.water.observations import Observations
from aquaflow.mapping.water.parameters import Model, Parameters, Trial
from aquaflow.mapping.water.priors import beliefs
from aquaflow.mapping.water.regions import RegionalColours
from aquaflow.mapping.water.shading import shading_basis

Array = npt.NDArray[np.float64]
Change = tuple[Array, Array | float]
"""By one parameter: of the errors, every J held, and of the log of J's factor; [M] each."""

BELIEVED = WaterPriorsConfig()
"""The priors that pay."""
NOISE = 0.01
"""Least colour noise of one observation."""
MAX_LOG_GAIN = 2.0
"""Guards the exponential of shading, exposure and unevenness."""
MAX_DEPTH = 30.0
"""Guards the exponential: optical depth between two sightings of a point."""
TINY = 1e-12
"""Guards the division by the light that arrives of a point."""


class WaterModel(Parameters):
    """Errors and their derivatives for one ``Model`` of the same sightings."""

    def __init__(
        self,
        seen: Observations,
        model: Model,
        B_res: Array,  # [3]
        d: Array,  # [3] 1 / map unit
        priors: WaterPriorsConfig = BELIEVED,
    ) -> None:
        super().__init__(model, int(seen.view.max()) + 1, float(np.median(seen.z)), priors)
        self.seen = seen
        self._regions = RegionalColours(seen.region)
        self._near = B_res * np.exp(-d * seen.z[:, None])
        self._basis = shading_basis(seen.xy)
        self._beyond = seen.z - mean_by(seen.point, seen.z[:, None])[seen.point, 0]
        self._around = seen.around
        self._cell = seen.point * self.views + seen.view

    def predict(
        self,
        x: Array,  # [K] parameters
        c: int,
    ) -> tuple[Array, Array]:
        """Errors [M] of one channel, predicted minus seen, and the best J [P] of every point."""
        predicted, J, _ = self._predict(self.trial(x), c)
        return predicted - self.seen.colour[:, c], J

    def without_water(
        self,
        x: Array,  # [K] parameters
        c: int,
    ) -> Array:
        """[M] what each observation of one channel would be without what lies between."""
        predicted, J, a = self._predict(self.trial(x), c)
        light = a * J[self.seen.point]
        return np.maximum((self.seen.colour[:, c] - (predicted - light)) / np.maximum(a, TINY), 0.0)

    def derivatives(
        self,
        x: Array,  # [K] parameters
        c: int,
    ) -> tuple[Array, Array]:
        """Of :meth:`predict`'s errors [K, M] and J [K, P] by the parameters ``of_channel(c)``."""
        trial, seen, points = self.trial(x), self.seen, self.seen.points
        predicted, J, a = self._predict(trial, c)
        errors = predicted - seen.colour[:, c]
        # dJ = -(sum a d(errors) + sum da errors) / sum a^2; no point is darker than black.
        power = np.maximum(np.bincount(seen.point, a * a, points), TINY)
        share: Array = np.where(J > 0.0, -1.0 / power, 0.0)
        # What is drawn from the surroundings is a part that no gain and no water changes.
        own_light = predicted - self._drawn_in(trial, c)
        changes = self._changes(trial, c, predicted, own_light, a * J[seen.point])
        direct = [of_errors for of_errors, _ in changes]
        by_J: list[Array] = [
            np.bincount(seen.point, a * (of_errors + of_log_a * errors), points) * share
            for of_errors, of_log_a in changes
        ]
        if self.model.exposure:
            # A view's gain touches its own sightings alone, and what is left of it the mean's.
            sums = np.bincount(self._cell, a * (own_light + errors), points * self.views)
            of_gains = sums.reshape(points, self.views).T * share
            by_J += list(of_gains - of_gains.mean(axis=0))
            own = np.full((self.views, len(a)), -own_light / self.views)
            own[seen.view, np.arange(len(a))] += own_light
            direct += list(own)
        stacked = np.stack(by_J)
        return np.stack(direct) + a * stacked[:, seen.point], stacked

    def _changes(
        self,
        trial: Trial,
        c: int,
        predicted: Array,  # [M]
        own_light: Array,  # [M] of it, what is not drawn from the surroundings
        light: Array,  # [M] of that, what comes from the points
    ) -> list[Change]:
        """By all parameters but exposures."""
        gain, seen = self._gain(trial, c), self.seen
        blended, basis = self._blended(trial, c, gain), list(self._basis.T)
        changes: list[Change] = []
        if self.model.water:
            beta_a, b, B_inf = trial.beta_a[c], trial.b[c], trial.B_inf[c]
            water_gain, passed = gain * self._uneven(trial), np.exp(-b * seen.z)
            fading = -beta_a * (light * seen.z + trial.trust * blended * self._beyond)
            growing = water_gain * B_inf * b * seen.z * passed
            rising = water_gain * B_inf * (1.0 - B_inf) * (1.0 - passed)
            changes += [(fading, -beta_a * seen.z), (growing, 0.0), (rising, 0.0)]
        if self.model.uneven:
            veil = gain * self._veil(trial, c)
            changes += [(veil * term, 0.0) for term in basis]
        contrast = -trial.blur * seen.z
        changes += [(blended, 0.0), (contrast * (predicted - self._around[:, c]), contrast)]
        if self.model.shading:
            changes += [(own_light * term, term) for term in basis]
        return changes

    def of_scene(
        self,
        J: Array,  # [3, P]
    ) -> Array:
        """[R] how far the points' colours are from what scenes without water have, whitened."""
        single = [belief.residual for belief in beliefs(J, self.believed)]
        if not self.believed.regions:
            return np.array(single)
        return np.concatenate([single, self._regions.residuals(J)])

    def of_scene_rows(
        self,
        J: Array,  # [3, P]
        changes: Sequence[tuple[npt.NDArray[np.int64], Array]],  # by channel: own, by_J [k, P]
    ) -> Array:
        """[R, K] derivatives of :meth:`of_scene`."""
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

    def sums_by_region(
        self,
        values: Array,  # [k, M]
    ) -> Array:
        """[k, R] sums of the observations of each region."""
        region = self.seen.region[self.seen.point]
        return np.stack([np.bincount(region, row) for row in values])

    def _predict(self, trial: Trial, c: int) -> tuple[Array, Array, Array]:
        """Predicted colours [M], J [P] (no point is darker than black), and J's factor [M]."""
        seen, gain = self.seen, self._gain(trial, c)
        a = gain * np.exp(-trial.beta_a[c] * seen.z)
        beside = trial.trust * self._blended(trial, c, gain) + gain * self._veil(trial, c)
        beside += self._drawn_in(trial, c)
        top = np.bincount(seen.point, a * (seen.colour[:, c] - beside), seen.points)
        bottom = np.maximum(np.bincount(seen.point, a * a, seen.points), TINY)
        J = np.maximum(top / bottom, 0.0)
        return a * J[seen.point] + beside, J, a

    def _sharpness(self, trial: Trial) -> Array:
        """[M] share of a point's contrast to its surroundings that is left."""
        return np.asarray(np.exp(-np.minimum(trial.blur * self.seen.z, MAX_DEPTH)))

    def _drawn_in(self, trial: Trial, c: int) -> Array:
        """[M] what looks like the surroundings."""
        return np.asarray((1.0 - self._sharpness(trial)) * self._around[:, c])

    def _veil(self, trial: Trial, c: int) -> Array:
        """[M] the backscatter."""
        if not self.model.water:
            return np.zeros_like(self.seen.z)
        grown = -np.expm1(-trial.b[c] * self.seen.z)
        return np.asarray(self._uneven(trial) * (trial.B_inf[c] * grown + self._near[:, c]))

    def _blended(
        self,
        trial: Trial,
        c: int,
        gain: Array,  # [M]
    ) -> Array:
        """[M] what the neighbours add to a point's colour, if the map is right."""
        depth = np.clip(trial.beta_a[c] * self._beyond, -MAX_DEPTH, MAX_DEPTH)
        return np.asarray(gain * np.exp(-depth) * self.seen.blend[:, c])

    def _uneven(self, trial: Trial) -> Array:
        return _gain(self._basis @ trial.unevenness)

    def _gain(self, trial: Trial, c: int) -> Array:
        gain = _gain(trial.exposure[self.seen.view, c] + self._basis @ trial.shading)
        return np.asarray(gain * self._sharpness(trial))


def _gain(
    log_gain: Array,  # [M]
) -> Array:
    return np.asarray(np.exp(np.clip(log_gain, -MAX_LOG_GAIN, MAX_LOG_GAIN)))
