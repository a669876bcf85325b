"""How the colours of places changed, once the water and the light of each day are taken off.

Restored colours stand in the white balance of their own day (docs/water.md), and nobody knows the
light. What changed everywhere alike is therefore light, water and exposure, and not the site: one
gain per channel, the median ratio over all places, is taken off. Saturation needs a grey: that of
the first day's camera with no water before it. The light at depth is bluer than that, so that what
is white there has some saturation of its own, and bleaching lowers it less than it would in white
light.

A place is bleached where it is lighter and less saturated. Both are needed, so that the larger of
the two one-sided probabilities is that of the two together (R. L. Berger, "Multiparameter
hypothesis testing and acceptance sampling", Technometrics 24 (1982): an intersection-union test).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.stats import norm

from aquaflow.survey.change.m3c2 import means_by, pairs_within, parts
from aquaflow.survey.change.significance import measured_spread
from aquaflow.survey.change.surface import Surface

Array = npt.NDArray[np.float64]

DARKEST = 0.02
"""Radiance below which a colour is the camera's noise: five grey levels."""
LEAST_POINTS = 5
"""Around a place; as in a cylinder."""


@dataclass(frozen=True)
class PlaceColours:
    """The colour of places on one day."""

    mean: Array
    """[N, 3] RGB; NaN where too few points are near."""
    sigma: Array
    """[N] relative, of the mean: spread of the points, and what restoration left open."""


@dataclass(frozen=True)
class ColourChange:
    """Colour change of each place; NaN where one of the days shows none."""

    lighter: Array
    """[N] natural log of the brightness over that of the first day, without what all share."""
    purer: Array
    """[N] saturation less that of the first day: standard deviation of the channels over mean."""
    sigma_lighter: Array
    sigma_purer: Array
    """[N] 1 sigma of both."""
    gains: tuple[float, float, float]
    """Of the second day's colours, that were taken off."""

    def bleach(self) -> Array:
        """[N] probability of a place as much lighter and less saturated where nothing changed."""
        up = norm.sf(self.lighter / self.sigma_lighter)
        down = norm.cdf(self.purer / self.sigma_purer)
        return np.asarray(np.maximum(up, down))


def shown_at(
    surface: Surface,
    places: Array,  # [N, 3] on the surface; NaN: none
    radius: float,
) -> PlaceColours:
    """The colour of a surface around places."""
    mean, sigma = np.full((len(places), 3), np.nan), np.full(len(places), np.nan)
    usable = np.flatnonzero(np.isfinite(places).all(axis=1))
    tree, apart = cKDTree(surface.points), np.pi * (radius / surface.resolution) ** 2
    for part in parts(len(usable)):
        which = usable[part]
        owner, near = pairs_within(tree, places[which], radius)
        number = np.bincount(owner, minlength=len(which))
        colours = surface.colours[near]
        middle = means_by(owner, colours, number)
        brightness = np.maximum(middle.mean(axis=1), DARKEST)
        offset = colours.mean(axis=1) - middle.mean(axis=1)[owner]
        own = np.column_stack([offset**2, surface.colour_sigma[near]])
        spread, left = means_by(owner, own, number).T
        independent = np.clip(number, 1.0, max(1.0, apart))
        enough = number >= LEAST_POINTS
        mean[which] = np.where(enough[:, None], middle, np.nan)
        relative = np.sqrt(spread / independent / brightness**2 + left**2)
        sigma[which] = np.where(enough, relative, np.nan)
    return PlaceColours(mean, sigma)


def colour_change(first: PlaceColours, second: PlaceColours) -> ColourChange:
    """The colour change from the first day to the second."""
    both = np.isfinite(first.mean).all(axis=1) & np.isfinite(second.mean).all(axis=1)
    lit = both & (first.mean > DARKEST).all(axis=1) & (second.mean > DARKEST).all(axis=1)
    gains = np.ones(3)
    if lit.any():
        gains = np.median(second.mean[lit] / first.mean[lit], axis=0)
    before = np.maximum(first.mean, DARKEST)
    after = np.maximum(second.mean / gains, DARKEST)
    lighter = np.where(lit, np.log(after.mean(axis=1) / before.mean(axis=1)), np.nan)
    purer = np.where(lit, _saturation(after) - _saturation(before), np.nan)
    stated = np.hypot(first.sigma, second.sigma)
    # Colours that are wrong alike on all channels leave the saturation as it is.
    lighter, sigma_lighter = _centre(lighter, stated)
    purer, sigma_purer = _centre(purer, stated * 0.5 * (_saturation(after) + _saturation(before)))
    red, green, blue = gains.tolist()
    return ColourChange(lighter, purer, sigma_lighter, sigma_purer, (red, green, blue))


def _saturation(
    colours: Array,  # [N, 3]
) -> Array:
    """[N] standard deviation of the channels over their mean."""
    return np.asarray(colours.std(axis=1) / colours.mean(axis=1))


def _centre(
    values: Array,  # [N]
    sigma: Array,  # [N]
) -> tuple[Array, Array]:
    """Values less their median, and sigmas of their spread.

    What restoration leaves open is shared by all places of a range, and most of it was taken off
    with the median: sigmas keep their proportions, and their size is measured.
    """
    values = values - (np.nanmedian(values) if np.isfinite(values).any() else 0.0)
    return values, sigma * measured_spread(values / sigma)
