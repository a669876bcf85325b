"""Where on the earth a dive was: latitude and longitude of points of n, and ``georeference.json``.

n is the plane that touches the WGS 84 ellipsoid at the origin, x to true north, z down. The water
surface (z = 0) is taken to lie on the ellipsoid: the geoid is within 110 m of it, which shifts a
latitude by less than 2 cm for each kilometre from the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.utm_grid import UtmGrid
from aquaflow.geometry.alignment import latitude_longitude
from aquaflow.telemetry.world_frame import Origin, WorldFrame

Array = npt.NDArray[np.float64]

GEOREFERENCE = "georeference.json"


def to_geodetic(
    origin: Origin,
    points_n: Array,  # [N, 3] m: north, east, down
) -> tuple[Array, Array]:
    """Latitude [N] and longitude [N], degrees, WGS 84."""
    return latitude_longitude(points_n, (origin.latitude_deg, origin.longitude_deg))


def georeference(frames: Mapping[int, WorldFrame], main: int) -> dict[str, Any] | None:
    """The content of ``georeference.json``; None if no position was heard.

    n and its origin are those of sub-map ``main``, or of the first sub-map that has an origin.
    """
    known = [frames[n] for n in sorted(frames, key=lambda n: (n != main, n)) if frames[n].origin]
    if not known or known[0].origin is None:
        return None
    frame, origin = known[0], known[0].origin
    return {
        "datum": "WGS 84",
        "epsg": 4326,
        "origin": {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "depth_m": 0.0 if frame.depth_known else None,
            "source": origin.source,
            "sigma_m": origin.sigma_m,
        },
        "axes": f"x {frame.north}, y to the right of it, z down; plane that touches the ellipsoid "
        "at the origin",
        "unit": frame.unit,
        "heading_sigma_deg": float(np.degrees(frame.heading_sigma_rad)),
        "utm": _utm(origin),
        "sub_maps": {
            str(number): {"georeferenced": each.georeferenced, "T_nm": each.T_nm.matrix.tolist()}
            for number, each in sorted(frames.items())
        },
    }


def _utm(origin: Origin) -> dict[str, Any] | None:
    """The origin on the grid, and how the grid's north differs from the true one there."""
    grid = UtmGrid.of(origin)
    if grid is None:
        return None
    from pyproj import Proj

    easting, northing = grid.places(np.zeros((1, 3)))[0].tolist()
    epsg = grid.epsg
    factors = Proj(f"EPSG:{epsg}").get_factors(origin.longitude_deg, origin.latitude_deg)
    return {
        "epsg": epsg,
        "zone": f"{epsg % 100}{'N' if epsg < 32700 else 'S'}",
        "easting_m": easting,
        "northing_m": northing,
        "convergence_deg": float(factors.meridian_convergence),
        "convergence": "grid bearing = true bearing - convergence_deg; nothing here is turned",
        "scale_factor": float(factors.meridional_scale),
    }
