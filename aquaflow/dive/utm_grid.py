"""The UTM grid that what a dive exports is laid on, where the dive's place on the earth is known.

Points of n are in metres north, east and down of the dive's origin (georeference.py). The zone is
that of the origin, for all points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.alignment import latitude_longitude
from aquaflow.telemetry.world_frame import Origin, WorldFrame

Array = npt.NDArray[np.float64]

LATITUDES_OF_UTM = (-80.0, 84.0)
"""Degrees; beyond, maps are polar stereographic."""
BASE_M = 100.0
"""Length over which north and the scale of the grid are measured. Taken as the same over a dive,
which 1 km from where they were measured is wrong by 3 mm in the scale and by less in the turn."""


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int | None:
    """EPSG code of the UTM zone (WGS 84) of a place; None near the poles.

    South-west Norway belongs to zone 32, and Svalbard has four wide zones.
    """
    low, high = LATITUDES_OF_UTM
    if not low <= latitude_deg <= high:
        return None
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    zone = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


@dataclass(frozen=True)
class UtmGrid:
    """The zone of an origin."""

    origin: Origin
    """Of n."""
    epsg: int

    @staticmethod
    def of(origin: Origin) -> UtmGrid | None:
        """None near the poles."""
        epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
        return None if epsg is None else UtmGrid(origin, epsg)

    def places(
        self,
        points_n: Array,  # [N, 3] m
    ) -> Array:
        """[N, 2] easting and northing, m."""
        from pyproj import Proj

        place = (self.origin.latitude_deg, self.origin.longitude_deg)
        latitude, longitude = latitude_longitude(points_n, place)
        return np.column_stack(Proj(f"EPSG:{self.epsg}")(longitude, latitude))

    def axes(
        self,
        point_n: Array,  # [3] m
    ) -> tuple[Array, float]:
        """R [3, 3] from east, north and up to the grid's axes at a point of n, and lengths on the
        grid over lengths in n there."""
        half = 0.5 * BASE_M * np.array([1.0, 0.0, 0.0])
        ends = self.places(np.array([point_n - half, point_n + half]))
        step = (ends[1] - ends[0]) / BASE_M
        scale = float(np.hypot(*step))
        east, north = step / scale
        return np.array([[north, east, 0.0], [-east, north, 0.0], [0.0, 0.0, 1.0]]), scale

    def wkt(self) -> str:
        """The coordinate reference system in OGC WKT 1, as LAS 1.4 demands."""
        from pyproj import CRS

        return str(CRS.from_epsg(self.epsg).to_wkt("WKT1_GDAL"))


def grid_of(frame: WorldFrame) -> UtmGrid | None:
    """The grid that a sub-map is laid on; None where it is not georeferenced, and near the
    poles."""
    if not frame.georeferenced or frame.origin is None:
        return None
    return UtmGrid.of(frame.origin)
