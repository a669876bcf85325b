"""Rays through a port: from the lens through glass into the water, and back from a point.

Both kinds of port are axial: every ray in the water meets the line through the centre of projection
along ``port.axis``, so a point and its ray lie in one plane with that line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.port import FlatPort, Port

Array = npt.NDArray[np.float64]

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
