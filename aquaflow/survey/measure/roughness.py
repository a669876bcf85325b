"""How rough the ground is: statistics of a height field that noise and resolution bias.

Noise of the heights adds slope that is not there; it is subtracted, to second order in the noise:
E f(g + n) = f(g) + tr(H S) / 2. The map's own resolution takes slope away. How much is estimated by
blurring the heights once more by that resolution; what that takes is added, and the
95 % interval reaches from nothing of it to twice as much. Numbers belong to the size of the cells:
the finer, the rougher the same ground. Overhangs have one height here, and do not count.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity

Array = npt.NDArray[np.float64]

MATCH_SIGMA = 0.25
"""What neighbouring cells err apart, over the sigma of rays known to 1 pixel: matches of two
pictures err by 0.12 to 0.25 px (notes/2026-11-tracking.md#backward); poses and camera, which
make up the rest of a pixel, move whole pictures."""
LEAST_CELLS = 30
"""With slopes, for statistics of them; judgement."""
RELIEF_PERCENT = (2.0, 98.0)
"""Percentiles between which relief is measured: the extremes are single cells of the map's rim."""


def surface_ratio(field: HeightField, tilt_sigma_rad: float = 0.0) -> Quantity:
    """Rugosity as the area of the surface over that of its plan, by triangles between cells.

    Each square of four cells is cut along both diagonals, and the mean taken. Friedman et al.,
    "Multi-Scale Measures of Rugosity, Slope and Aspect from Benthic Stereo Image Reconstructions",
    PLoS ONE 7(12), 2012.

    Raises:
        InputError: too little is mapped.
    """

    def mean(
        heights: Array,  # [h, w]
    ) -> float:
        triangles = [np.sqrt(1.0 + p**2 + q**2) for p, q in _triangles(heights, field.cell)]
        return float(np.nanmean(_enough(np.mean(triangles, axis=0))))

    def bias() -> float:
        s = _noise(field)[:-1, :-1] ** 2 / field.cell**2
        squares = [p**2 + q**2 for p, q in _triangles(field.height, field.cell)]
        each = [s * (2.0 + g2) / (1.0 + g2) ** 1.5 for g2 in squares]
        return float(np.nanmean(np.mean(each, axis=0)))

    return _correct(field, mean, bias, tilt_sigma_rad)


def chain_ratio(field: HeightField, tilt_sigma_rad: float = 0.0) -> Quantity:
    """Rugosity as the length of a chain laid over the ground, over that of its plan.

    The mean of virtual transects along all rows and columns of cells, with one link a cell. Risk,
    "Fish diversity on a coral reef in the Virgin Islands", Atoll Research Bulletin 153, 1972.

    Raises:
        InputError: too little is mapped.
    """

    def slopes(
        heights: Array,  # [h, w]
    ) -> list[Array]:
        return [np.diff(heights, axis=axis) / field.cell for axis in (0, 1)]

    def mean(
        heights: Array,  # [h, w]
    ) -> float:
        links = np.concatenate([np.sqrt(1.0 + p**2).ravel() for p in slopes(heights)])
        return float(np.nanmean(_enough(links)))

    def bias() -> float:
        s = _noise(field) ** 2 / field.cell**2
        links = zip((s[:-1], s[:, :-1]), slopes(field.height), strict=True)
        each = [(noise / (1.0 + p**2) ** 1.5).ravel() for noise, p in links]
        return float(np.nanmean(np.concatenate(each)))

    return _correct(field, mean, bias, tilt_sigma_rad)


def slope(field: HeightField, percent: float, tilt_sigma_rad: float = 0.0) -> Quantity:
    """A percentile of the angle between the ground and the horizontal, degrees.

    Raises:
        InputError: too little is mapped.
    """
    removed = _noise(field) ** 2 / field.cell**2

    def of(
        squares: Array,  # [h, w] tangents, squared
    ) -> float:
        tangents = np.sqrt(np.maximum(_enough(squares), 0.0))
        return float(np.degrees(np.arctan(np.nanpercentile(tangents, percent))))

    plain = of(_gradient2(field.height, field.cell))
    quiet = of(_gradient2(field.height, field.cell) - removed)
    lost = max(0.0, plain - of(_gradient2(field.blurred, field.cell)))
    value = quiet + lost
    tilt = NORMAL_95 * np.degrees(tilt_sigma_rad)
    low, high = (float(np.hypot(tilt, off)) for off in (plain - quiet + lost, lost))
    return _between(value, low, high + (plain - quiet), "\u00b0", 0.0)


def relief(field: HeightField, tilt_sigma_rad: float, scale_sigma: float, unit: str) -> Quantity:
    """Height between the percentiles RELIEF_PERCENT of the cells.

    Its sigma takes the shared errors of the heights as independent at both ends, with the vertical
    and the scale.

    Raises:
        InputError: too little is mapped.
    """

    def span(
        heights: Array,  # [h, w]
    ) -> float:
        low, high = np.nanpercentile(_enough(heights), RELIEF_PERCENT)
        return float(high - low)

    plain = span(field.height)
    lost = max(0.0, plain - span(field.blurred))
    known = np.argwhere(field.mapped)
    wide = field.cell * float(np.linalg.norm(np.ptp(known, axis=0)))
    ends = float(np.sqrt(2.0) * np.nanmedian(field.sigma))
    # Where on the ground the two ends lie is not known: half the diagonal apart, say.
    sigma = float(np.linalg.norm([ends, 0.5 * wide * tilt_sigma_rad, scale_sigma * plain]))
    half = float(np.hypot(NORMAL_95 * sigma, lost))
    return _between(plain + lost, half, half, unit, 0.0)


def _correct(
    field: HeightField,
    of: Callable[[Array], float],
    noise: Callable[[], float],
    tilt_sigma_rad: float,
) -> Quantity:
    """A ratio of the heights, less what noise adds, with what the resolution took."""
    plain = of(field.height)
    lost, added = max(0.0, plain - of(field.blurred)), noise()
    # A vertical that errs along the ground's mean slope makes the plan larger or smaller by that.
    steep = [np.nanmean(each) for each in np.gradient(field.height, field.cell)]
    tilt = NORMAL_95 * tilt_sigma_rad * plain * float(np.linalg.norm(steep))
    half = float(np.linalg.norm([added, lost, tilt]))
    return _between(max(1.0, plain - added + lost), half, half, "", 1.0)


def _between(value: float, below: float, above: float, unit: str, least: float) -> Quantity:
    """With a 95 % interval that reaches so far down and up."""
    sigma = 0.5 * (below + above) / NORMAL_95
    return Quantity(value, sigma, max(least, value - below), value + above, unit)


def _noise(field: HeightField) -> Array:
    """[h, w] 1 sigma of what a cell's height errs against its neighbours'."""
    return MATCH_SIGMA * field.sigma


def _triangles(
    heights: Array,  # [h, w]
    cell: float,
) -> list[tuple[Array, Array]]:
    """Slopes [h-1, w-1] along x and y of the four triangles that two diagonals make."""
    top, bottom = np.diff(heights[:-1], axis=1) / cell, np.diff(heights[1:], axis=1) / cell
    left, right = np.diff(heights[:, :-1], axis=0) / cell, np.diff(heights[:, 1:], axis=0) / cell
    return [(top, left), (top, right), (bottom, left), (bottom, right)]


def _gradient2(
    heights: Array,  # [h, w]
    cell: float,
) -> Array:
    """[h, w] squared tangent of the slope by central differences; NaN beside holes."""
    if min(heights.shape) < 2:
        return np.full(heights.shape, np.nan)
    along_y, along_x = np.gradient(heights, cell)
    return np.asarray(along_x**2 + along_y**2)


def _enough(
    values: Array,  # [...]
) -> Array:
    """The same; raises InputError if too few are finite."""
    if int(np.isfinite(values).sum()) < LEAST_CELLS:
        raise InputError(
            f"fewer than {LEAST_CELLS} cells of the ground have a height and neighbours; give a "
            "smaller --cell or map more of it"
        )
    return values
