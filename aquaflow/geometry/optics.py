"""The whole way of light: from a distorted pixel through lens and port into the water, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.port import FlatPort, Port

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


# --------------------------------------------------------------------------------------------------
# Lens distortion by OpenCV's models: distorted pixels of rays, and rays of distorted pixels.

NEWTON_ITERATIONS = 50
"""Limit of the search for the point that is distorted to a given one."""
CONVERGED = 1e-15
"""Step at z = 1 after which none changes the point."""
MAX_UNDISTORTION_ERROR_PX = 0.01
"""Error up to which that search counts as successful; beyond, the lens model has no inverse
there."""


def distort_points(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Distorted pixels [M, 2] of the rays through ``points``; NaN stays NaN."""
    import cv2

    if not camera.is_distorted:
        return camera.project(np.concatenate([points, np.ones((len(points), 1))], axis=1))
    if camera.distortion_model == "radtan":
        return _distort(points, camera)[0]
    coefficients = camera.coefficients
    pixels = cv2.fisheye.distortPoints(points[:, None], camera.K, coefficients)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def undistort_points(
    pixels: npt.NDArray[np.float64],  # [M, 2] px, distorted
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Points [M, 2] at z = 1 on the rays of distorted pixels; NaN where there is no such ray.

    OpenCV's own inverse of ``radtan`` stops after five rounds, pixels away at wide corners.
    """
    import cv2

    if not camera.is_distorted:
        return camera.unproject(pixels)[:, :2]
    coefficients = camera.coefficients
    if camera.distortion_model == "fisheye":
        points = cv2.fisheye.undistortPoints(pixels[:, None], camera.K, coefficients)[:, 0]
        # OpenCV marks what did not converge with -1e6.
        lost = np.abs(points).max(1, keepdims=True) > 1e5
        return np.where(lost, np.nan, points).astype(np.float64)
    points = camera.unproject(pixels)[:, :2]
    for _ in range(NEWTON_ITERATIONS):
        found, J = _distort(points, camera)
        error = np.nan_to_num(found - pixels, posinf=1e9, neginf=-1e9)
        step = np.einsum("nij,nj->ni", np.linalg.pinv(J), error)
        # Half a radian at most: far out the polynomial sends Newton anywhere.
        points = points - step / np.maximum(1.0, 2.0 * np.linalg.norm(step, axis=1))[:, None]
        if np.abs(step).max(initial=0.0) < CONVERGED:
            break
    found, _ = _distort(points, camera)
    close = np.linalg.norm(found - pixels, axis=1) < MAX_UNDISTORTION_ERROR_PX
    return np.where((close & _unfold(points, camera))[:, None], points, np.nan)


def _distort(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Pixels [M, 2] where ``radtan`` sees the points, and their derivative [M, 2, 2]."""
    import cv2

    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    zero, coefficients = np.zeros(3), camera.coefficients
    pixels, J = cv2.projectPoints(rays, zero, zero, camera.K, coefficients)
    # With the identity as pose, moving the camera by (tx, ty) moves the point by as much.
    derivative = np.nan_to_num(np.asarray(J[:, 3:5], dtype=np.float64)).reshape(-1, 2, 2)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), derivative


def _unfold(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> npt.NDArray[np.bool_]:
    """[M] True where the way from the centre to the point never turns back in the picture."""
    unfolded = np.ones(len(points), dtype=bool)
    for share in np.linspace(0.05, 1.0, 20):
        unfolded &= np.linalg.det(_distort(share * points, camera)[1]) > 0.0
    return unfolded


# --------------------------------------------------------------------------------------------------
# Rays through a port: from the lens through glass into the water, and back from a point.
#
# Both kinds of port are axial: every ray in the water meets the line through the centre of
# projection along ``port.axis``, so a point and its ray lie in one plane with that line.

ANGLE_TOLERANCE_RAD = 1e-13
"""Of the search for the ray to a point; well under 1e-9 of a pixel."""
MISS_TOLERANCE = 1e-9
"""Largest distance of the ray from its point, over the point's range, that counts as found."""
STEEPEST_RAD = 0.5 * np.pi - 1e-9
"""Between a ray in air and the normal of a flat port; at more it does not reach the port."""


def refract(
    rays: Array,  # [..., 3] unit vectors
    normals: Array,  # [..., 3] unit vectors, to the side that the rays go to
    ratio: float,
) -> Array:
    """Unit vectors [..., 3] behind a surface; NaN where the ray is reflected totally.

    Args:
        rays: before the surface.
        normals: of the surface.
        ratio: refractive index before the surface over that behind.
    """
    cosine = np.sum(rays * normals, axis=-1, keepdims=True)
    behind = (1.0 - ratio**2) + (ratio * cosine) ** 2
    through = np.sqrt(np.where((behind >= 0.0) & (cosine > 0.0), behind, np.nan))
    return np.asarray(ratio * rays + (through - ratio * cosine) * normals)


def rays_in_water(
    port: Port,
    rays: Array,  # [..., 3] unit vectors in air, from the centre of projection
) -> tuple[Array, Array]:
    """Where rays leave the port [..., 3] (m) and their unit vectors [..., 3] in water.

    NaN where a ray does not reach the water.
    """
    if isinstance(port, FlatPort):
        normals = np.broadcast_to(port.axis, rays.shape)
        inner = _to_plane(rays, normals, port.distance_m)
        in_glass = refract(rays, normals, 1.0 / port.glass)
        outer = inner + _to_plane(in_glass, normals, port.thickness_m)
        return outer, refract(in_glass, normals, port.glass / port.water)
    centre = np.array(port.centre_m)
    inner = _to_sphere(np.zeros_like(rays), rays, centre, port.radius_m)
    in_glass = refract(rays, (inner - centre) / port.radius_m, 1.0 / port.glass)
    radius = port.radius_m + port.thickness_m
    outer = _to_sphere(inner, in_glass, centre, radius)
    return outer, refract(in_glass, (outer - centre) / radius, port.glass / port.water)


def rays_to_points(
    port: Port,
    points: Array,  # [..., 3] m, camera frame
) -> Array:
    """Unit vectors [..., 3] in air under which ``points`` in the water are seen.

    NaN for points that no ray reaches: inside the housing, or outside the cone that a flat port
    lets in.
    """
    from scipy.optimize import elementwise

    axis = port.axis
    along = points @ axis
    aside = points - along[..., None] * axis
    radius = np.linalg.norm(aside, axis=-1)
    flat = port.align()
    last = STEEPEST_RAD if isinstance(port, FlatPort) else np.pi
    seen = np.isfinite(radius + along) & (
        _miss(np.full_like(radius, last), radius, along, flat) < 0
    )
    at = (np.where(seen, radius, 0.0), np.where(seen, along, 1.0))

    def miss(angle: Array, *point: Any) -> Array:
        return _miss(angle, point[0], point[1], flat)

    found = elementwise.find_root(
        miss,
        (np.zeros_like(radius), np.full_like(radius, last)),
        args=at,
        tolerances={"xatol": ANGLE_TOLERANCE_RAD, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0},
    )
    angle = np.where(_reaches(found.x, radius, along, flat), found.x, np.nan)
    direction = aside / np.where(radius > 0.0, radius, 1.0)[..., None]
    return np.asarray(np.cos(angle)[..., None] * axis + np.sin(angle)[..., None] * direction)


def _miss(
    angle: Array,  # [...] rad, of the ray in air from the axis
    radius: Array,  # [...] m, of the point from the axis
    along: Array,  # [...] m, of the point along the axis
    port: Port,  # aligned
) -> Array:
    """Signed distance [...] (m) of the ray in water from the point; it falls with the angle."""
    origin, ray = _in_plane(angle, port)
    return np.asarray(
        (radius - origin[..., 0]) * ray[..., 2] - (along - origin[..., 2]) * ray[..., 0]
    )


def _reaches(
    angle: Array,  # [...] rad
    radius: Array,  # [...] m
    along: Array,  # [...] m
    port: Port,  # aligned
) -> npt.NDArray[np.bool_]:
    """[...] True where the ray in water, not what lies behind its start, passes the point."""
    origin, ray = _in_plane(angle, port)
    ahead = (radius - origin[..., 0]) * ray[..., 0] + (along - origin[..., 2]) * ray[..., 2]
    range_m = np.hypot(radius, along)
    return np.asarray(
        (ahead >= 0.0) & (np.abs(_miss(angle, radius, along, port)) <= MISS_TOLERANCE * range_m)
    )


def _in_plane(
    angle: Array,  # [...] rad
    port: Port,  # aligned
) -> tuple[Array, Array]:
    air = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    return rays_in_water(port, air)


def _to_plane(
    rays: Array,  # [..., 3] unit vectors
    normals: Array,  # [..., 3]
    distance: float,
) -> Array:
    """[..., 3] m along ``rays`` up to ``distance`` along ``normals``; NaN for rays away from it."""
    cosine = np.sum(rays * normals, axis=-1, keepdims=True)
    return np.asarray(rays * (distance / np.where(cosine > 0.0, cosine, np.nan)))


def _to_sphere(
    start: Array,  # [..., 3] m, inside the sphere
    rays: Array,  # [..., 3] unit vectors
    centre: Array,  # [3] m
    radius: float,
) -> Array:
    """[..., 3] m where ``rays`` leave the sphere."""
    from_centre = start - centre
    middle = np.sum(rays * from_centre, axis=-1, keepdims=True)
    outside = np.sum(from_centre**2, axis=-1, keepdims=True) - radius**2
    return np.asarray(start + rays * (np.sqrt(middle**2 - outside) - middle))


# --------------------------------------------------------------------------------------------------
# What a calibration may have left of a lens in pictures that it undistorted.
#
# A ray through (x, y, 1) is seen at ``exp(u) (1 + k r^2 + l r^4) (x, y) + (x0, y0)`` of the
# normalised picture plane; a right calibration leaves u = k = l = x0 = y0 = 0.

LENS_PRIOR_SIGMA = np.array([0.3, 0.3, 0.1, 0.01, 0.01])
"""Of u, k, l, x0 and y0 before anything was seen: air for water is a factor of 1.33, a strong lens
has k = 0.3, and the centre of a picture is known to a hundredth of the focal length."""

TERMS = len(LENS_PRIOR_SIGMA)
"""Numbers of a lens error: u, k, l, x0 and y0."""
ROUNDS = 15
"""Fixed-point steps of the inverse; more change less than a thousandth of a pixel."""
MIN_FACTOR = 0.1
"""Of the radial distortion: where it falls below, the model folds over."""


def seen_at(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2] where a camera with the error ``lens`` sees ``rays``, on the normalised plane."""
    return np.asarray(np.exp(lens[0]) * _factor(rays, lens) * rays + lens[3:])


def rays_of(
    seen: Array,  # [N, 2]
    lens: Array,  # [5]
) -> Array:
    """[N, 2] the inverse of :func:`seen_at`."""
    scaled = (seen - lens[3:]) * np.exp(-lens[0])
    rays = scaled
    for _ in range(ROUNDS):
        rays = scaled / np.maximum(_factor(rays, lens), MIN_FACTOR)
    return np.asarray(rays)


def _factor(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 1] of the radial distortion."""
    squared = _square(rays)
    return np.asarray(1.0 + lens[1] * squared + lens[2] * squared**2)


def slope(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2, 2] of :func:`seen_at` by the rays."""
    growth = (2.0 * lens[1] + 4.0 * lens[2] * _square(rays))[..., None]
    bend = growth * rays[:, :, None] * rays[:, None, :]
    return np.asarray(np.exp(lens[0]) * (_factor(rays, lens)[..., None] * np.eye(2) + bend))


def by_lens(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2, 5] of :func:`seen_at` by the errors of the lens."""
    squared, scaled = _square(rays), np.exp(lens[0]) * rays
    radial = [_factor(rays, lens) * scaled, squared * scaled, squared**2 * scaled]
    centre = np.broadcast_to(np.eye(2), (len(rays), 2, 2))
    return np.concatenate([np.stack(radial, axis=-1), centre], axis=-1)


def _square(
    rays: Array,  # [N, 2] x and y at z = 1
) -> Array:
    """[N, 1] squared radius."""
    return np.asarray(np.sum(rays**2, axis=-1, keepdims=True))
