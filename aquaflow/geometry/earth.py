"""Positions on the earth in the plane that touches the WGS 84 ellipsoid at an origin."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from pyproj import Transformer


Array = npt.NDArray[np.float64]


def north_east(
    latitude_deg: Array,  # [N]
    longitude_deg: Array,  # [N]
    origin: tuple[float, float],
) -> Array:
    """[N, 2] m north and east of ``origin`` (latitude, longitude, deg), of points at height 0."""
    height = np.zeros(len(latitude_deg))
    east, north, _ = _plane(origin).transform(longitude_deg, latitude_deg, height)
    return np.stack([north, east], axis=1)


def latitude_longitude(
    points_n: Array,  # [N, 3] m: north, east, down
    origin: tuple[float, float],
) -> tuple[Array, Array]:
    """Latitude [N] and longitude [N], deg, of points around ``origin``."""
    north, east, down = np.asarray(points_n, np.float64).T
    longitude, latitude, _ = _plane(origin).transform(east, north, -down, direction="INVERSE")
    return np.asarray(latitude), np.asarray(longitude)


def from_geodetic(
    latitude_deg: Array,  # [N]
    longitude_deg: Array,  # [N]
    height: Array,  # [N] m above the ellipsoid
    origin: tuple[float, float],
) -> Array:
    """[N, 3] m north, east and down of ``origin`` (latitude, longitude, deg)."""
    east, north, up = _plane(origin).transform(longitude_deg, latitude_deg, height)
    return np.stack([north, east, -up], axis=1)


def geodetic(
    points_n: Array,  # [N, 3] m: north, east, down
    origin: tuple[float, float],
) -> Array:
    """[N, 3] longitude, latitude (deg) and height above the ellipsoid (m), in GeoJSON's order."""
    north, east, down = np.asarray(points_n, np.float64).T
    return np.stack(_plane(origin).transform(east, north, -down, direction="INVERSE"), axis=1)


def _plane(origin: tuple[float, float]) -> Transformer:
    """From longitude, latitude (deg) and height (m) to east, north and up (m)."""
    from pyproj import Transformer

    latitude, longitude = origin
    steps = (
        "+step +proj=unitconvert +xy_in=deg +xy_out=rad",
        "+step +proj=cart +ellps=WGS84",
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0=0",
    )
    return Transformer.from_pipeline(f"+proj=pipeline {' '.join(steps)}")
