"""The whole way of light: from a distorted pixel through lens and port into the water, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.distortion import distort_points, undistort_points
from aquaflow.geometry.refraction import rays_in_water, rays_to_points

Array = npt.NDArray[np.float64]


def rays_of_pixels(
    camera: CameraModel,
    pixels: Array,  # [M, 2] px, distorted
) -> tuple[Array, Array]:
    """Origins [M, 3] (m) and unit vectors [M, 3] of the rays in the scene, camera frame.

    NaN for pixels that no ray reaches. Without a port the origins are zero.
    """
    slopes = undistort_points(pixels, camera)
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return (np.zeros_like(rays), rays) if camera.port is None else rays_in_water(camera.port, rays)


def pixels_of_points(
    camera: CameraModel,
    points: Array,  # [M, 3] m, camera frame
) -> Array:
    """Distorted pixels [M, 2] where ``points`` in the scene are seen; NaN where they are not."""
    rays = points if camera.port is None else rays_to_points(camera.port, points)
    depth = np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
    return distort_points(rays[:, :2] / depth, camera)


def points_at_depth(
    camera: CameraModel,
    pixels: Array,  # [M, 2] px, distorted
    depth_m: float,
) -> Array:
    """Points [M, 3] (m, camera frame) in which the rays of ``pixels`` meet the plane z = depth."""
    origins, rays = rays_of_pixels(camera, pixels)
    return np.asarray(origins + rays * ((depth_m - origins[:, 2:]) / rays[:, 2:]))


def virtual_centre(camera: CameraModel) -> Array:
    """[3] m: the point on the port's axis that the rays of the picture pass most closely.

    Of all pinhole cameras, the one that stands there errs least at other ranges than the one that
    it is fitted to: the squared slope of that error over inverse range, summed over a grid of
    pixels, is least (Lucas et al. 2017, "Pinax", choose it for the centre of the picture).
    """
    if camera.port is None:
        return np.zeros(3)
    along = (np.arange(GRID) + 0.5) / GRID
    grid = np.stack(np.meshgrid(along * camera.width, along * camera.height), -1).reshape(-1, 2)
    offset, per_metre = _parallax(camera, grid)
    seen = np.isfinite(offset).all(axis=1)
    share = float(
        np.sum(offset[seen] * per_metre[seen]) / max(np.sum(per_metre[seen] ** 2), 1e-300)
    )
    return share * camera.port.axis


GRID = 24
"""Pixels along each side of the picture that say where the rays meet."""


def _parallax(
    camera: CameraModel,
    pixels: Array,  # [M, 2] px, distorted
) -> tuple[Array, Array]:
    """How a pixel's slope changes with inverse range, [M, 2] m, and by how much less so for a
    centre that lies a metre along the port's axis, [M, 2]."""
    assert camera.port is not None
    origins, rays = rays_of_pixels(camera, pixels)
    slopes, axis = rays[:, :2] / rays[:, 2:], camera.port.axis
    return origins[:, :2] - origins[:, 2:] * slopes, axis[:2] - axis[2] * slopes
