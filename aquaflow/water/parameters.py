"""What may lie between a surface point's colour and the picture's, as one vector of numbers.

The water has nine, its unevenness and the camera's shading five each, every view's exposure three.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

Array = npt.NDArray[np.float64]

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
EXPOSURE_SIGMA = 0.01, 0.5
"""Prior: log-gain of a view against the mean of all, its least and its largest sigma; what it is
between them, the views' own gains say (empirical Bayes). Two stops span a dive's auto-exposure. One
wide sigma for all dives lets gains that follow the range of each view take the place of the water:
beta_a of a rendered dive of even light doubled, and Curasao's."""
TINT_SIGMA = 0.005, 0.1
"""Prior: the same of how much a channel's log-gain differs from the mean of the three."""
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

    @property
    def is_possible(self) -> bool:
        """Unevenness takes water."""
        return self.water or not self.uneven

    @property
    def takes_open_water(self) -> bool:
        """Shading and unevenness look alike, unless there is open water in view."""
        return self.uneven and self.shading


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


class WaterUnknowns:
    """Where each number of a ``Model`` lies in the vector, what it stands for, and its prior.

    In the order log beta_a, log b, logit B_inf, unevenness, shading, exposures.
    """

    def __init__(self, model: Model, views: int, median_range: float) -> None:
        """``median_range`` of what is seen, map units: rates are expected relative to it."""
        self.model, self.views = model, views
        self.median_range = median_range
        sizes = (
            WATER * model.water,
            TERMS * model.uneven,
            TERMS * model.shading,
            3 * views * model.exposure,
        )
        ends = np.cumsum((0, *sizes)).tolist()
        self.parts = [slice(*ends[k : k + 2]) for k in range(len(ends) - 1)]
        self.water, self.uneven, self.shading, self.exposure = self.parts
        self.size = ends[-1]
        self.start = np.zeros(self.size)
        if model.water:
            red = np.log(OPTICAL_DEPTH / median_range)
            green = red - RED_OVER_GREEN
            rates = [red, green, green + BLUE_OVER_GREEN]
            self.start[self.water] = [*rates, *rates, *[B_INF_LOGIT] * 3]
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
        shared = range(self.uneven.start, self.shading.stop)
        return np.array([*water, *shared, *range(self.exposure.start + c, self.size, 3)], np.int64)

    def trial(
        self,
        x: Array,  # [K] parameters
    ) -> Trial:
        """What the parameters stand for."""
        wet, model = np.zeros((3, 3)), self.model
        if model.water:
            rates, logit = np.clip(x[:6], -MAX_LOG_RATE, MAX_LOG_RATE), x[6:WATER]
            wet[:2] = np.exp(rates).reshape(2, 3)
            wet[2] = 1.0 / (1.0 + np.exp(-np.clip(logit, -MAX_LOGIT, MAX_LOGIT)))
        unevenness = x[self.uneven] if model.uneven else np.zeros(TERMS)
        shading = x[self.shading] if model.shading else np.zeros(TERMS)
        exposure = x[self.exposure] if model.exposure else np.zeros(3 * self.views)
        exposure = exposure.reshape(self.views, 3)
        return Trial(wet[0], wet[1], wet[2], unevenness, shading, exposure - exposure.mean(axis=0))

    def priors(
        self,
        x: Array,  # [K] parameters
    ) -> tuple[Array, Array]:
        """Whitened residuals [R] of the linear priors, and their derivatives [R, K]."""
        return self._rows @ (x - self.start), self._rows

    def _prior_rows(self, exposure: float, tint: float) -> Array:
        """[R, K]; sigmas of the views' log-gains."""
        rows = np.zeros((self.size, self.size))
        if self.model.water:
            rates = np.arange(3)
            rows[:3, :3] = RATE_ROWS
            rows[3 + rates, 3 + rates] = 1.0 / RATE_RATIO_SIGMA
            rows[3 + rates, rates] = -1.0 / RATE_RATIO_SIGMA
            rows[6 + rates, 6 + rates] = 1.0 / B_INF_SIGMA
        if self.model.uneven:
            rows[self.uneven, self.uneven] = np.diag(1.0 / UNEVEN_SIGMA)
        if self.model.shading:
            rows[self.shading, self.shading] = np.diag(1.0 / SHADING_SIGMA)
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
MAX_LOG_GAIN = 2.0
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
    x = (np.arange(width) + 0.5) / (0.5 * width) - 1.0
    y = (np.arange(height) + 0.5) / (0.5 * height) - 1.0
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    log_gain = np.clip(shading_basis(xy) @ coefficients, -MAX_LOG_GAIN, MAX_LOG_GAIN)
    return np.exp(log_gain).astype(np.float32)
