"""What sightings of surface points look like through trial water, and how that changes with it.

An observation of point p in view v is ``gain_v shade(x, y) (J_p T(z) + uneven(x, y) B(z))`` (paper,
Eq. 12), with T the share of J that is seen: what the water leaves of the light, a lamp's included.
The best J of every point is linear, so it is eliminated (variable projection); what remains lies in
one vector.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from aquaflow.config import WaterPriorsConfig
from aquaflow.water import mounting
from aquaflow.water.beliefs import RegionalColours, beliefs
from aquaflow.water.mounting import Lamp, LampLight, MountedLight
from aquaflow.water.observations import Observations

# --------------------------------------------------------------------------------------------------
# What may lie between a surface point's colour and the picture's, as one vector of numbers.
#
# The water has nine, its unevenness and the camera's shading five each, every view's exposure
# three.

OPTICAL_DEPTH, OPTICAL_DEPTH_SIGMA = 0.7, 0.9
"""Prior: red light's optical depth at the median range, and its sigma in the log. An ROV works 1 to
3 m from what it looks at, where Jerlov's waters take 0.3 to 2 (aquaflow/lab/synthetic/water.py)."""
RED_OVER_GREEN, RED_OVER_GREEN_SIGMA = 0.6, 0.6
"""Prior: log of the ratio of the attenuations. Jerlov's oceanic IB to coastal 5C: 0.24 to 1.29,
mean 0.8, deviation 0.4; wider and nearer to zero, as a camera's channels mix the colours."""
BLUE_OVER_GREEN, BLUE_OVER_GREEN_SIGMA = 0.0, 0.5
"""Prior: the same for blue; -0.46 to 0.24, mean -0.05, deviation 0.3."""
RATE_RATIO_SIGMA = 0.5
"""Prior: log of b over beta_a; both come from the same absorption and scattering."""
B_INF_LOGIT, B_INF_SIGMA = -1.0, 1.5
"""Prior: logit of B_inf (0.27), weak."""
UNEVEN_SIGMA = np.array([0.2, 0.5, 0.15, 0.1, 0.15])
"""Prior: log-gain of the backscatter at the edge of the picture, by term; sunlit water is several
times as bright looked at horizontally as from above, a little brighter towards the sun, and changes
evenly from one side to the other."""
SHADING_SIGMA = np.array([0.04, 0.04, 0.3, 0.04, 0.3])
"""Prior: log-gain at the edge of the picture, by term; a third is a strong lamp fall-off, and both
lamp and lens are on the whole alike on all sides."""
BRIGHTER_SIGMA = 0.02
"""Prior: the same where an even term would make the edge brighter: no lens does, and what a camera
corrects too far is a few per cent. Left free, 0.17 to 0.5 take the water's place on IUI3
(notes/2026-11-water.md#brighter)."""
EXPOSURE_SIGMA = 0.01, 0.5
"""Prior: log-gain of a view against the mean of all, its least and its largest sigma; what it is
between them, the views' own gains say (empirical Bayes). Two stops span a dive's auto-exposure. One
wide sigma for all dives lets gains that follow the range of each view take the place of the water:
beta_a of a rendered dive of even light doubled, and Curasao's."""
TINT_SIGMA = 0.005, 0.1
"""Prior: the same of how much a channel's log-gain differs from the mean of the three."""
LAMP_SHARE_SIGMA = 1.5
"""Prior: logit of the lamp's share in the light, around a half; weak."""
LIT_SHADING_SIGMA = np.array([0.01, 0.01, 0.3, 0.01, 0.3])
"""Prior: the same with lamps, whose places and cone are numbers of their own: what is left is the
lens's, and alike on all sides."""
LAMP_POWER, LAMP_POWER_SIGMA = 2.0, 0.03
"""Prior: power of the range by which a lamp's light falls, besides what its mounting does: 2 of a
point. Left free (0.25) it takes the attenuation's place."""
SEEN_POWER_SIGMA = 0.5
"""The same where no mounting is known: ground turns away as it recedes, 1.9 to 2.5 on rendered
dives."""
GLOW, GLOW_SIGMA = -3.5, 1.0
"""Prior: log of what the water returns of a lamp's light (0.03); 0.02 to 0.1 on rendered dives."""
LAMP = 2 + len(mounting.START)
"""Logit of the share, the power and the mounting, of all channels; the glow's three come on top."""
WATER = 9
"""log beta_a, log b and logit B_inf, RGB each."""
MAX_LOG_RATE = 5.0
"""Guards the exponential; such water is black at a hundredth of a map unit."""
MAX_LOGIT = 10.0
"""Guards the exponential; B_inf is black or white to 0.005 %."""


def rate_rows(red: float, red_over_green: float, blue_over_green: float) -> Array:
    """[3, 3] by which log beta_a is whitened: red by itself, red over green and blue over green,
    each with its sigma."""
    contrasts = np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [0.0, -1.0, 1.0]])
    return np.asarray(contrasts / np.array([[red], [red_over_green], [blue_over_green]]))


RATE_ROWS = rate_rows(OPTICAL_DEPTH_SIGMA, RED_OVER_GREEN_SIGMA, BLUE_OVER_GREEN_SIGMA)
"""Of water that is not clear."""
HELD_SIGMA = 1e-4
"""Of log beta_a where it is given."""
GREY = np.full((3, 3), 1.0 / 3.0)
"""Takes RGB to the mean of the three."""


@dataclass(frozen=True)
class Model:
    """What may lie between a point's colour and the picture's."""

    water: bool = False
    shading: bool = False
    exposure: bool = False
    uneven: bool = False
    """Backscatter brighter on one side of the picture than on the other; takes water."""
    lamp: bool = False
    """Light from beside the camera; takes water."""

    @property
    def is_possible(self) -> bool:
        """Unevenness and lamps take water."""
        return self.water or not (self.uneven or self.lamp)

    @property
    def takes_open_water(self) -> bool:
        """Shading and unevenness look alike, unless there is open water in view."""
        return self.uneven and self.shading


def with_lamp(models: Sequence[Model]) -> list[Model]:
    """The same with a lamp, of those in water; most backscatter is the lamp's then, and even."""
    return [replace(model, lamp=True) for model in models if model.water and not model.uneven]


@dataclass(frozen=True)
class Trial:
    """Parameters as what they stand for; those that the model lacks have no effect."""

    beta_a: Array
    """[3] per map unit."""
    b: Array
    """[3] per map unit."""
    B_inf: Array
    """[3]"""
    unevenness: Array
    """[5] log-gain of the backscatter over the picture."""
    shading: Array
    """[5] log-gain over the picture."""
    exposure: Array
    """[V, 3] log-gain of each view, of mean zero: no sighting tells brighter points from brighter
    views."""
    lamp: Lamp | None = None
    glow: Array = field(default_factory=lambda: np.zeros(3))
    """[3] of the lamp's light that the water returns, nearly all of it close by: as from any range.
    It stands in for the residual of the backscatter."""
    mounting: Array = field(default_factory=lambda: mounting.START)
    """[5] of the lamp."""

    def transmission(
        self,
        z: Array,  # [...]
    ) -> Array:
        """[..., 3] share of J that is seen, by a lamp at the camera."""
        T = np.exp(-self.beta_a * z[..., None])
        return T if self.lamp is None else T * self.lamp.light(self.beta_a, z)


class WaterUnknowns:
    """Where each number of a ``Model`` lies in the vector, what it stands for, and its prior.

    In the order log beta_a, log b, logit B_inf, unevenness, shading, lamp, log glow, exposures.
    """

    def __init__(self, model: Model, views: int, median_range: float) -> None:
        """``median_range`` of what is seen, map units: rates are expected relative to it."""
        self.model, self.views = model, views
        self.median_range = median_range
        sizes = (
            WATER * model.water,
            TERMS * model.uneven,
            TERMS * model.shading,
            LAMP * model.lamp,
            3 * model.lamp,
            3 * views * model.exposure,
        )
        ends = np.cumsum((0, *sizes)).tolist()
        self.parts = [slice(*ends[k : k + 2]) for k in range(len(ends) - 1)]
        self.water, self.uneven, self.shading, self.lamp, self.glow, self.exposure = self.parts
        self.size = ends[-1]
        self.start = np.zeros(self.size)
        if model.water:
            red = np.log(OPTICAL_DEPTH / median_range)
            green = red - RED_OVER_GREEN
            rates = [red, green, green + BLUE_OVER_GREEN]
            self.start[self.water] = [*rates, *rates, *[B_INF_LOGIT] * 3]
        if model.lamp:
            self.start[self.lamp] = [0.0, LAMP_POWER, *mounting.START]
            self.start[self.glow] = GLOW
        self._rate_rows, self._power_sigma = RATE_ROWS, LAMP_POWER_SIGMA
        self._rows = self._prior_rows(EXPOSURE_SIGMA[0], TINT_SIGMA[0])

    def expecting(
        self,
        x: Array,  # [K] parameters
    ) -> Self:
        """The same, with the exposures expected to differ by as much as these do."""
        if not self.model.exposure:
            return self
        exposure = x[self.exposure].reshape(self.views, 3)
        grey = exposure.mean(axis=1, keepdims=True)
        sigma, tint = (
            float(np.clip(np.sqrt(np.mean(part**2)), *bounds))
            for part, bounds in ((grey, EXPOSURE_SIGMA), (exposure - grey, TINT_SIGMA))
        )
        changed = copy.copy(self)
        changed._rows = self._prior_rows(sigma, tint)
        return changed

    def holding(
        self,
        log_beta_a: Array,  # [3]
    ) -> Self:
        """The same, with that attenuation, and a lamp's fall that is not known before."""
        changed = copy.copy(self)
        changed.start = self.start.copy()
        changed.start[:3] = log_beta_a
        changed._rate_rows, changed._power_sigma = np.eye(3) / HELD_SIGMA, SEEN_POWER_SIGMA
        changed._rows = changed._prior_rows(EXPOSURE_SIGMA[0], TINT_SIGMA[0])
        return changed

    def adopt(
        self,
        other: WaterUnknowns,
        x: Array,  # [K] parameters
    ) -> Array:
        """The start, with the parameters of ``other``'s fit where both models have them."""
        adopted = self.start.copy()
        for mine, theirs in zip(self.parts, other.parts, strict=True):
            if mine.stop - mine.start == theirs.stop - theirs.start:
                adopted[mine] = x[theirs]
        return adopted

    def of_channel(self, c: int) -> npt.NDArray[np.int64]:
        """Where in the vector the parameters lie that channel ``c`` depends on."""
        water = [c, 3 + c, 6 + c] if self.model.water else []
        shared = range(self.uneven.start, self.lamp.stop)
        # The glow's three, and of each view three, where there are any.
        own = range(self.glow.start + c, self.size, 3)
        return np.array([*water, *shared, *own], np.int64)

    def trial(
        self,
        x: Array,  # [K] parameters
    ) -> Trial:
        """What the parameters stand for."""
        wet, model = np.zeros((3, 3)), self.model
        if model.water:
            rates, logit = np.clip(x[:6], -MAX_LOG_RATE, MAX_LOG_RATE), x[6:WATER]
            wet[:2] = np.exp(rates).reshape(2, 3)
            wet[2] = _share(logit)
        unevenness = x[self.uneven] if model.uneven else np.zeros(TERMS)
        shading = x[self.shading] if model.shading else np.zeros(TERMS)
        exposure = x[self.exposure] if model.exposure else np.zeros(3 * self.views)
        exposure = exposure.reshape(self.views, 3)
        exposure = exposure - exposure.mean(axis=0)
        trial = Trial(wet[0], wet[1], wet[2], unevenness, shading, exposure)
        if not model.lamp:
            return trial
        logit, power = x[self.lamp][:2].tolist()
        glow = np.exp(np.clip(x[self.glow], -MAX_LOGIT, 0.0))
        lamp = Lamp(float(_share(logit)), power, self.median_range)
        return replace(trial, lamp=lamp, glow=glow, mounting=x[self.lamp][2:])

    def priors(
        self,
        x: Array,  # [K] parameters
    ) -> tuple[Array, Array]:
        """Whitened residuals [R] of the linear priors, and their derivatives [R, K]."""
        rows = self._rows
        if self.model.shading:
            brighter = self.shading.start + EVEN[x[self.shading][EVEN] > 0.0]
            rows = rows.copy()
            rows[brighter, brighter] = 1.0 / BRIGHTER_SIGMA
        return rows @ (x - self.start), rows

    def _prior_rows(self, exposure: float, tint: float) -> Array:
        """[R, K]; sigmas of the views' log-gains."""
        rows = np.zeros((self.size, self.size))
        if self.model.water:
            rates = np.arange(3)
            rows[:3, :3] = self._rate_rows
            rows[3 + rates, 3 + rates] = 1.0 / RATE_RATIO_SIGMA
            rows[3 + rates, rates] = -1.0 / RATE_RATIO_SIGMA
            rows[6 + rates, 6 + rates] = 1.0 / B_INF_SIGMA
        if self.model.uneven:
            rows[self.uneven, self.uneven] = np.diag(1.0 / UNEVEN_SIGMA)
        if self.model.shading:
            of_lens = LIT_SHADING_SIGMA if self.model.lamp else SHADING_SIGMA
            rows[self.shading, self.shading] = np.diag(1.0 / of_lens)
        if self.model.lamp:
            sigma = np.array([LAMP_SHARE_SIGMA, self._power_sigma, *mounting.SIGMA])
            rows[self.lamp, self.lamp] = np.diag(1.0 / sigma)
            rows[self.glow, self.glow] = np.eye(3) / GLOW_SIGMA
        if self.model.exposure:
            rows[self.exposure, self.exposure] = np.kron(
                np.eye(self.views), GREY / (np.sqrt(3.0) * exposure) + (np.eye(3) - GREY) / tint
            )
        return rows


# --------------------------------------------------------------------------------------------------
# How the camera darkens its own picture: lamp and lens fall-off, fixed to the camera.
#
# A smooth gain g(x, y) = exp(q(x, y)) multiplies the whole picture, water included; q is a
# quadratic without a constant, so g = 1 in the middle. The paper has none; without it a lamp's
# fall-off is taken for water.

TERMS = 5
"""x, y, x^2, x y and y^2: vignetting and a lamp at the side; a constant would be exposure."""
EVEN = np.array([2, 4])
"""x^2 and y^2 among them."""
"""Guards the exponential: a picture seven times darker at its edge shows nothing there anyway."""


def shading_basis(
    xy: Array,  # [..., 2] picture position, each axis from -1 to 1
) -> Array:
    """[..., 5]: x, y, x^2, x y, y^2."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def gain_map(
    coefficients: Array,  # [5]
    height: int,
    width: int,
) -> npt.NDArray[np.float32]:
    """g [H, W] at the pixel centres."""
    if not coefficients.any():
        return np.ones((height, width), np.float32)
    x = (np.arange(width) + 0.5) / (0.5 * width) - 1.0
    y = (np.arange(height) + 0.5) / (0.5 * height) - 1.0
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    log_gain = np.clip(shading_basis(xy) @ coefficients, -MAX_LOG_GAIN, MAX_LOG_GAIN)
    return np.exp(log_gain).astype(np.float32)


Array = npt.NDArray[np.float64]


# --------------------------------------------------------------------------------------------------
# The model of trial water.

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
    light: LampLight | None
    """Of a lamp."""


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
        # By a lamp, what is near may well be brighter than white by daylight.
        self.believed = priors.model_copy(update={"saturation": False}) if model.lamp else priors
        self.seen = seen
        self._regions = RegionalColours(seen.region)
        self._B_res, self._d = B_res, d
        self._near = B_res[:, None] * np.exp(-d[:, None] * seen.z)
        self._basis = np.ascontiguousarray(shading_basis(seen.xy).T)
        self._colour = np.ascontiguousarray(seen.colour.T)
        self._mounted: MountedLight | None = None
        if model.lamp and seen.ray is not None and seen.normal is not None:
            z = seen.z / seen.median_range
            self._mounted = MountedLight(seen.ray, seen.normal, z, self._basis)

    @property
    def knows_mounting(self) -> bool:
        """Whether it has a lamp that may be elsewhere than at the camera."""
        return self._mounted is not None

    def predict(
        self,
        x: Array,  # [K] parameters
        weight: Array | None = None,  # [3, M] of the observations; None: all alike
    ) -> Prediction:
        """The observations, with the J that fit them best at these weights."""
        trial, seen = self.trial(x), self.seen
        gain = _gain(trial.exposure.T[:, seen.view] + trial.shading @ self._basis)
        a, near, light = gain * np.exp(-trial.beta_a[:, None] * seen.z), self._near, None
        if trial.lamp is not None:
            light = self.light_of(trial, trial.lamp)
            a, near = a * (1.0 - trial.lamp.share + light.beam), light.glow
        backscatter = gain * self._backscatter(trial, seen.z, self._basis, near)
        weighed = a if weight is None else weight * a
        own = self._colour - backscatter
        power = np.maximum(seen.sums_by_point(weighed * a), TINY)
        J = np.maximum(seen.sums_by_point(weighed * own) / power, 0.0)
        return Prediction(trial, gain, a, backscatter, J, a * J[:, seen.point] - own, power, light)

    def at_the_camera(
        self,
        x: Array,  # [K] parameters
    ) -> WaterModel:
        """The same water, with a lamp at the camera whose fall is that of the light as it is seen:
        its mounting is not known, nor the surface's normals."""
        seen = replace(self.seen, ray=None, normal=None)
        plain = WaterModel(seen, self.model, self._B_res, self._d, self.believed)
        return plain.holding(x[:3])

    def light_of(self, trial: Trial, lamp: Lamp) -> LampLight:
        """The trial's lamp on the observations, where it is mounted if that can be told."""
        beam = lamp.beam(trial.beta_a, self.seen.z).T
        glow = np.broadcast_to(trial.glow[:, None], beam.shape)
        if self._mounted is None:
            return LampLight.of_camera(beam, glow)
        return self._mounted.light(trial.mounting, beam, glow)

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
        near = near if trial.lamp is None else trial.glow[:, None]
        veil = self._backscatter(trial, z, basis, near)
        T = np.maximum(trial.transmission(z).T, TINY)
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
            return np.zeros((3, len(z)))
        grown = -np.expm1(-trial.b[:, None] * z)
        return np.asarray(_gain(trial.unevenness @ basis) * (trial.B_inf[:, None] * grown + near))

    def derivatives(
        self,
        now: Prediction,
        weight: Array,  # [M] of the channel, that its J were found with
        c: int,
    ) -> Derivatives:
        """Derivatives of :meth:`predict`'s errors and J, the weights held."""
        seen, a, trial = self.seen, now.a[c], now.trial
        light = a * now.J[c, seen.point]
        lit = light + now.backscatter[c]
        direct: list[Array] = []
        if self.model.water:
            beta_a, b, B_inf = trial.beta_a[c], trial.b[c], trial.B_inf[c]
            water_gain = now.gain[c] * _gain(trial.unevenness @ self._basis)
            passed = np.exp(-b * seen.z)
            path = seen.z
            if trial.lamp is not None and now.light is not None:
                beam, glow = now.light.beam[c], water_gain * now.light.glow[c]
                lit_by = 1.0 - trial.lamp.share + beam
                path = path * (1.0 + beam / lit_by)
            direct += [-beta_a * path * light, water_gain * B_inf * b * seen.z * passed]
            direct += [water_gain * B_inf * (1.0 - B_inf) * (1.0 - passed)]
        if self.model.uneven:
            direct += list(now.backscatter[c] * self._basis)
        if self.model.shading:
            direct += list(lit * self._basis)
        if trial.lamp is not None and now.light is not None:
            log_nearer = np.log(trial.lamp.range / seen.z)
            share = (1.0 - trial.lamp.share) * (beam - trial.lamp.share)
            by_beam = light * beam / lit_by
            direct += [light * share / lit_by, by_beam * log_nearer]
            direct += list(by_beam * now.light.beam_slopes + glow * now.light.glow_slopes)
            direct += [glow]
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


def _share(
    logit: Array | float,  # [...]
) -> Array:
    """[...] in (0, 1)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logit, -MAX_LOGIT, MAX_LOGIT))))


def _gain(
    log_gain: Array,  # [...]
) -> Array:
    return np.asarray(np.exp(np.clip(log_gain, -MAX_LOG_GAIN, MAX_LOG_GAIN)))
