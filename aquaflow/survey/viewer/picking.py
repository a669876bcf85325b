"""Where a ray meets the map: the range by which half of the light is stopped that it stops at all.

Along a ray a Gaussian's density is a Gaussian again; its largest value is where the gradient of the
Mahalanobis distance is across the ray (B. Keetha et al., SplaTAM, and L. Radl et al., StopThePop,
eq. 8, use the same point). Ordered by that range, the Gaussians are composed as a picture is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.viewer.splats import ViewerSplats, covariances

Array = npt.NDArray[np.float64]

REACH = 3.0
"""Standard deviations beyond which a Gaussian stops nothing: exp(-4.5) is 1 %."""
LEAST_ALPHA = 0.5
"""Of the map along the ray; less is mostly not there. As in dive/scale_bar."""
MOST_CROSSED = 20_000
"""Gaussians along one ray that are looked at, the widest first; more stand before the eye."""
ONE_SIGMA = (0.16, 0.5, 0.84)
"""Shares of the stopped light: the surface, and one standard deviation of a normal distribution to
either side. A faint Gaussian far behind would change a mean, but not these."""
CLICK_PX = 1.0
"""1 sigma of a point that a person marked, pixels of the browser; as in dive/scale_bar."""


@dataclass(frozen=True)
class PickedGaussian:
    """A point of the map, and how well it is known."""

    place: Array
    """[3]"""
    range: float
    """From the ray's origin."""
    sigma: float
    """1 sigma of where the surface is: by how much the Gaussians along the ray differ, and by how
    much a pixel is wide there."""


def pick(
    splats: ViewerSplats,
    origin: Array,  # [3]
    direction: Array,  # [3] of any length
    pixel_rad: float,
    beam_rad: float | None = None,
) -> PickedGaussian:
    """The point that a person means who points along a ray.

    Args:
        pixel_rad: width of a pixel, by which a person errs.
        beam_rad: 1 sigma of the ray's own width, by default a pixel. Where Gaussians are smaller
            than pixels there are gaps between them, which a picture does not show either.

    Raises:
        InputError: the map shows nothing there, or the ray is none.
    """
    length = float(np.linalg.norm(direction))
    beam = pixel_rad if beam_rad is None else beam_rad
    numbers = np.array([*origin, *direction, pixel_rad, beam])
    if not (np.isfinite(numbers).all() and length > 0.0 and 0.0 <= pixel_rad < 1.0):
        raise InputError("the ray to pick along is none; point at the map again")
    ray = np.asarray(direction, np.float64) / length
    near = _near(splats, np.asarray(origin, np.float64), ray, beam)
    ranges, alphas = _intersect(splats, near, np.asarray(origin, np.float64), ray, beam)
    order = np.argsort(ranges)
    ranges, alphas = ranges[order], alphas[order]
    left = np.concatenate([[1.0], np.cumprod(1.0 - alphas)])
    if len(ranges) == 0 or 1.0 - left[-1] < LEAST_ALPHA:
        raise InputError("the map shows nothing there; point at another place")
    share = left[:-1] * alphas
    stopped = np.cumsum(share)
    low, middle, high = np.interp(np.array(ONE_SIGMA) * stopped[-1], stopped, ranges).tolist()
    sigma = float(np.hypot(0.5 * (high - low), CLICK_PX * pixel_rad * middle))
    return PickedGaussian(np.asarray(origin) + middle * ray, middle, sigma)


def within_reach(
    splats: ViewerSplats,
    origin: Array,  # [3]
    spanning: Array,  # [2, 3] two directions of a plane
    width: float,
) -> ViewerSplats:
    """Those that a ray, 1 sigma of ``width``, within the plane through ``origin`` can cross: far
    fewer, for many rays."""
    normal = np.cross(spanning[0], spanning[1])
    length = float(np.linalg.norm(normal))
    if not (np.isfinite(length) and length > 0.0):
        return splats
    apart = np.abs((splats.centres - origin.astype(np.float32)) @ (normal / length))
    return splats.among(apart <= REACH * np.hypot(splats.scales.max(axis=1, initial=0.0), width))


def _near(
    splats: ViewerSplats,
    origin: Array,  # [3]
    ray: Array,  # [3] unit
    beam: float,
) -> npt.NDArray[np.intp]:
    """Those whose sphere of ``REACH`` sigma the ray crosses, in front of its origin."""
    away = splats.centres - origin.astype(np.float32)
    along = away @ ray.astype(np.float32)
    apart = np.einsum("ij,ij->i", away, away) - along**2
    reach = REACH * np.hypot(splats.scales.max(axis=1, initial=0.0), beam * along)
    found = np.flatnonzero((apart < reach**2) & (along > 0.0))
    if len(found) > MOST_CROSSED:
        found = found[np.argsort(-splats.scales[found].max(axis=1))[:MOST_CROSSED]]
    return found


def _intersect(
    splats: ViewerSplats,
    near: npt.NDArray[np.intp],  # [M]
    origin: Array,  # [3]
    ray: Array,  # [3] unit
    beam: float,
) -> tuple[Array, Array]:
    """Range and alpha [M] of each where the ray is deepest inside of it."""
    away = splats.centres[near].astype(np.float64) - origin
    C = covariances(splats.wxyz[near], splats.scales[near]).astype(np.float64)
    # A flat Gaussian has no inverse: a thousandth of its size is thin enough.
    C += (1e-6 * np.trace(C, axis1=1, axis2=2) + 1e-30)[:, None, None] * np.eye(3)
    C += ((beam * (away @ ray)) ** 2)[:, None, None] * (np.eye(3) - np.outer(ray, ray))
    precision = np.linalg.inv(C)
    across = np.einsum("nij,j->ni", precision, ray)
    ranges = np.einsum("ni,ni->n", across, away) / np.maximum(across @ ray, 1e-30)
    missed = away - ranges[:, None] * ray
    squared = np.einsum("ni,nij,nj->n", missed, precision, missed)
    alphas = np.clip(splats.opacities[near] * np.exp(-0.5 * squared), 0.0, 0.99)
    ahead = ranges > 0.0
    return ranges[ahead], alphas[ahead]
