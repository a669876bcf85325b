"""Depth of matched pixels from two known views, with the uncertainty that the parallax allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.float64]

MIN_PARALLAX_RAD = np.radians(0.15)
"""Below this angle a depth from two views is noise (notes/measurements.md#pose-solver)."""

MAX_REPROJECTION_PX = 1.5
"""A match further than this from its epipolar line is an outlier, not a measurement."""

MIN_DEPTH = 1e-3
"""Nearer points, and those behind a camera, are no measurement."""

MIN_RHO, MAX_RHO = 1e-9, 1e6
"""Inverse depths outside are no measurement; held there, their inverse is finite."""

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
    sin_parallax: Array
    """[M] sine of the angle between the two rays."""


def triangulate(
    rays_a: Array,  # [M, 3], z = 1, camera a
    pixels_b: Array,  # [M, 2] px
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
    expected_rho: Array | None = None,  # [M] 1 / z in a; 0 where nothing is expected
) -> Triangulation:
    """Point on each ray of a that is nearest to the matched ray of b.

    The variance is first order: ``sigma_px`` along the epipolar line moves the inverse depth by
    (sigma / f) * rho / sin(parallax). It and the parallax are taken at ``expected_rho`` where there
    is one: taken at the measurement, noise would choose its own weight, the nearer the surer, and
    far points of a forward view would come out near.
    """
    # One array for each coordinate: several times faster than [M, 3] arrays, and it is the frame's
    # whole picture that comes through here.
    xa, ya = rays_a[:, 0], rays_a[:, 1]
    xb, yb = (
        (pixels_b[:, 0] - camera_b.cx) / camera_b.fx,
        (pixels_b[:, 1] - camera_b.cy) / camera_b.fy,
    )
    ax, ay, az = (row[0] * xa + row[1] * ya + row[2] for row in T_ba.R)
    t_ba = T_ba.in_source_unit().t
    tx, ty, tz = t_ba
    # x_b ~ a_in_b + rho t  =>  x_b x (a_in_b + rho t) = 0, solved for rho by least squares. Solved
    # for z, the noise of x_b would be in the divisor, and every depth too small by its variance.
    cx, cy, cz = yb * az - ay, ax - xb * az, xb * ay - yb * ax
    dx, dy, dz = yb * tz - ty, tx - xb * tz, xb * ty - yb * tx
    cc = cx * cx + cy * cy + cz * cz
    dd = dx * dx + dy * dy + dz * dz
    rho = -(cx * dx + cy * dy + cz * dz) / np.maximum(dd, 1e-18)
    z_safe = 1.0 / np.clip(rho, MIN_RHO, MAX_RHO)

    expected_z = z_safe
    if expected_rho is not None:
        expected_z = np.where(
            expected_rho > MIN_RHO, 1.0 / np.maximum(expected_rho, MIN_RHO), z_safe
        )
    sine = _sin_parallax(xa, ya, expected_z, -(T_ba.R.T @ t_ba))
    in_b_z = z_safe * az + tz
    inverse = 1.0 / np.maximum(in_b_z, MIN_DEPTH)
    off_u = camera_b.fx * ((z_safe * ax + tx) * inverse - xb)
    off_v = camera_b.fy * ((z_safe * ay + ty) * inverse - yb)
    good = (rho > MIN_RHO) & (z_safe > MIN_DEPTH) & (in_b_z > MIN_DEPTH)
    good &= off_u * off_u + off_v * off_v < MAX_REPROJECTION_PX**2
    # Parallel rays meet nowhere; their z is rounding noise over the guard.
    good &= (sine > np.sin(MIN_PARALLAX_RAD)) & (cc > MIN_CROSS_SQ)
    sigma = (sigma_px / camera_b.fx) / (expected_z * np.maximum(sine, 1e-6))
    return Triangulation(1.0 / z_safe, sigma * sigma, good, sine)


def _sin_parallax(
    x: Array,  # [M]
    y: Array,  # [M]
    z: Array,  # [M] depth
    centre: Array,  # [3] of camera b in a
) -> Array:
    """[M] between the ray (x, y, 1) z of a and the line from b's centre to its end."""
    # ray x (z ray - centre) = -ray x centre, whatever z is.
    cx, cy, cz = centre
    ux, uy, uz = y * cz - cy, cx - x * cz, x * cy - y * cx
    across_sq = ux * ux + uy * uy + uz * uz
    along = z * (x * x + y * y + 1.0) - (x * cx + y * cy + cz)
    return np.asarray(np.sqrt(across_sq / np.maximum(across_sq + along * along, 1e-300)))
