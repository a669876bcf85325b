"""Positions on the earth in a local frame: exact on the WGS 84 ellipsoid, by way of ECEF.

Source: NIMA TR8350.2, Department of Defense World Geodetic System 1984, 3rd edition.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SEMI_MAJOR_M = 6_378_137.0
"""m, WGS 84."""
FLATTENING = 1.0 / 298.257223563
"""WGS 84."""
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
"""Squared, of the ellipse through the poles."""


def north_east(
    latitude_deg: Array,  # [N]
    longitude_deg: Array,  # [N]
    origin: tuple[float, float],
) -> Array:
    """[N, 2] m north and east of ``origin`` (latitude, longitude, deg), in its tangent plane."""
    latitude, longitude = (np.radians(value) for value in origin)
    apart = _ecef(latitude_deg, longitude_deg) - _ecef(np.array([origin[0]]), np.array([origin[1]]))
    north = np.array(
        [
            -np.sin(latitude) * np.cos(longitude),
            -np.sin(latitude) * np.sin(longitude),
            np.cos(latitude),
        ]
    )
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    return np.stack([apart @ north, apart @ east], axis=1)


def _ecef(
    latitude_deg: Array,  # [N]
    longitude_deg: Array,  # [N]
) -> Array:
    """[N, 3] m, points of the ellipsoid."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    across = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    level = across * np.cos(latitude)
    up = (1.0 - ECCENTRICITY_2) * across * np.sin(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude), up], axis=1)
