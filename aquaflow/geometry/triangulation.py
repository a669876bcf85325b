"""Depth of matched pixels from two known views, with the uncertainty that the parallax allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.float64]

MIN_PARALLAX_RAD = np.radians(0.15)
"""Below this angle a depth from two views is noise (prior_notes.md section 4: 0.15-0.3 degrees)."""

MAX_REPROJECTION_PX = 1.5
"""A match further than this from its epipolar line is an outlier, not a measurement."""

MIN_DEPTH = 1e-3
"""Nearer points, and those behind a camera, are no measurement."""

MIN_CROSS_SQ = 1e-12
"""Squared sine of the angle below which rays are parallel: their depth is rounding noise."""


@dataclass(frozen=True)
class Triangulation:
    """Inverse depths in view a, one per match."""

    rho: Array
    """[M] 1 / z in a."""
    variance: Array
    """[M] variance of ``rho``."""
    good: npt.NDArray[np.bool_]
    """[M] in front of both cameras, enough parallax, close to the epipolar line."""
    parallax_rad: Array
    """[M] angle between the two rays."""


def triangulate(
    rays_a: Array,  # [M, 3], z = 1, camera a
    pixels_b: Array,  # [M, 2] px
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
) -> Triangulation:
    """Point on each ray of a that is nearest to the matched ray of b.

    The variance is first order: ``sigma_px`` along the epipolar line moves the inverse depth by
    (sigma / f) * rho / sin(parallax).
    """
    rays_b = camera_b.unproject(pixels_b)
    a_in_b = rays_a @ T_ba.R.T
    # x_b ~ z_a a_in_b + t  =>  x_b x (z_a a_in_b + t) = 0, solved for z_a by least squares.
    c = _cross_unit_depth(rays_b, a_in_b)
    d = _cross_unit_depth(rays_b, T_ba.t)
    cc = _dot(c, c)
    z = -_dot(c, d) / np.maximum(cc, 1e-18)
    z_safe = np.maximum(z, 1e-6)

    in_b = z_safe[:, None] * a_in_b + T_ba.t
    centre_b_in_a = -(T_ba.R.T @ T_ba.t)
    from_b = rays_a * z_safe[:, None] - centre_b_in_a
    across = _cross_unit_depth(rays_a, from_b)
    parallax = np.arctan2(np.sqrt(_dot(across, across)), _dot(rays_a, from_b))

    error = np.linalg.norm(camera_b.project(in_b) - pixels_b, axis=1)
    good = (z > MIN_DEPTH) & (in_b[:, 2] > MIN_DEPTH) & (error < MAX_REPROJECTION_PX)
    # Parallel rays meet nowhere; their z is rounding noise over the guard.
    good &= (parallax > MIN_PARALLAX_RAD) & (cc > MIN_CROSS_SQ)
    rho = 1.0 / z_safe
    sigma = (sigma_px / camera_b.fx) * rho / np.maximum(np.sin(parallax), 1e-6)
    return Triangulation(rho, sigma**2, good, parallax)


def _cross_unit_depth(
    x: Array,  # [M, 3] with z = 1
    y: Array,  # [M, 3] or [3]
) -> Array:
    """x cross y [M, 3]; several times faster than numpy's general one."""
    y0, y1, y2 = y[..., 0], y[..., 1], y[..., 2]
    return np.stack([x[:, 1] * y2 - y1, y0 - x[:, 0] * y2, x[:, 0] * y1 - x[:, 1] * y0], -1)


def _dot(x: Array, y: Array) -> Array:
    """[M] inner products of rows."""
    return np.asarray(np.einsum("ij,ij->i", x, y))
