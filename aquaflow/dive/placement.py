"""Where a dive lies: upright, on the earth and its UTM grid, on a page, and in an earlier dive.

The upright frame u, which all exports are in, has the origin and the unit of n
(docs/conventions.md#world-n). Its axes are right, forward and up of what n's x axis points to:
east, north, up where that is true north. Where n has no vertical, the first keyframe's camera has
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.arrays import sim3_to_json
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.telemetry.world_frame import Origin, WorldFrame
from aquaflow.tracking.base import BaseLink, InBase

Array = npt.NDArray[np.float64]

UPRIGHT_FROM_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Right, forward, up from forward, right, down."""
UPRIGHT_FROM_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Right, forward, up from right, down, forward."""


@dataclass(frozen=True)
class Placement:
    """Where the exported points of one sub-map lie."""

    T_un: Sim3
    """From n to the upright frame: a rotation alone."""
    unit: str
    """``m`` or ``map units``."""
    directions: tuple[str, str]
    """What x and y of the upright frame point to, in words."""
    grid: UtmGrid | None = None
    """Where the points are laid on one."""

    @property
    def epsg(self) -> int | None:
        """EPSG code of the grid; None where there is none."""
        return None if self.grid is None else self.grid.epsg

    def on_grid(
        self,
        points_u: Array,  # [N, 3] unit, upright frame
    ) -> Array:
        """[N, 3] easting, northing and height (m) in the UTM zone; unchanged where there is none.

        The height is that above z = 0 of n.
        """
        if self.grid is None:
            return points_u
        places = self.grid.places(self.T_un.inverse().apply(points_u))
        return np.column_stack([places, points_u[:, 2]])

    def turned_to_grid(
        self,
        directions_u: Array,  # [N, 3] upright frame
    ) -> Array:
        """[N, 3] the same directions against the grid's north in place of the true one."""
        if self.grid is None:
            return directions_u
        return np.asarray(directions_u @ self.grid.axes(np.zeros(3))[0].T)

    def wkt(self) -> str | None:
        """The grid's coordinate reference system in OGC WKT 1, as LAS 1.4 demands; or None."""
        return None if self.grid is None else self.grid.wkt()

    @property
    def axes(self) -> str:
        """The upright frame in words."""
        x, y = self.directions
        return f"x {x}, y {y}, z up"

    def in_words(self, y_up: bool = False) -> str:
        """Axes, unit and grid of exported points, in one line; ``y_up``: x, z, -y of them."""
        x, y = self.directions if self.epsg is None else ("easting", "northing")
        named = f"x {x}, y up, -z {y}" if y_up else f"x {x}, y {y}, z up"
        return f"{'' if self.epsg is None else f'EPSG:{self.epsg}, '}{named}; {self.unit}"


def placement(frame: WorldFrame) -> Placement:
    """The placement of the sub-map that ``frame`` belongs to."""
    R, directions = UPRIGHT_FROM_DOWN, ("to the right", frame.ahead)
    if not frame.has_vertical:
        R, directions = UPRIGHT_FROM_CAMERA, ("right", "into the first keyframe's picture")
    elif frame.north == "true north":
        directions = "east", "north"
    return Placement(Sim3(R, np.zeros(3), 1.0), frame.unit, directions, grid_of(frame))


# --------------------------------------------------------------------------------------------------
# The UTM grid that what a dive exports is laid on, where the dive's place on the earth is known.
#
# Points of n are in metres north, east and down of the dive's origin. The zone is
# that of the origin, for all points.

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


# --------------------------------------------------------------------------------------------------
# Where on the earth a dive was: latitude and longitude of points of n, and ``georeference.json``.
#
# n is the plane that touches the WGS 84 ellipsoid at the origin, x to true north, z down. The water
# surface (z = 0) is taken to lie on the ellipsoid: the geoid is within 110 m of it, which shifts a
# latitude by less than 2 cm for each kilometre from the origin.

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
        "axes": f"{frame.axes}; plane that touches the ellipsoid at the origin",
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


# --------------------------------------------------------------------------------------------------
# The plane of a plan view: what points to the right and up on the page.

LEVEL = UPRIGHT_FROM_DOWN[:2]
"""Rows: what points right and up on the page, in n, where -z is up."""
FORWARD = UPRIGHT_FROM_CAMERA[:2]
FACING = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The same where n has no vertical, and has the first picture's axes: right, down, ahead."""
FROM_ABOVE, OFF_GROUND = "from above", "square to the ground"
"""From where a LEVEL page is seen: with gravity, and for want of it."""


def page_axes(
    frame: WorldFrame,
    path: Array,  # [N, 3] camera centres, n
) -> Array:
    """[2, 3] the directions of n that are right and up on the page: LEVEL, FORWARD or FACING."""
    if frame.has_vertical:
        return LEVEL
    spread = np.ptp(path, axis=0)
    return FORWARD if spread[2] >= spread[1] else FACING


def page_rotation(
    axes: Array,  # [2, 3] as from page_axes
) -> Array:
    """R [3, 3] from n to the page: right, up, and towards who looks at it."""
    return np.vstack([axes, np.cross(axes[0], axes[1])])


def names_of(frame: WorldFrame, axes: Array) -> tuple[str, str, str]:  # [2, 3] of page_axes
    """From where the page is seen, and what right and up on it are, in words."""
    if axes is FACING:
        return "as in the first picture", "right", "up"
    if axes is FORWARD:
        return "from above the first picture", "right of it", "ahead of it"
    seen, up = FROM_ABOVE if frame.level else OFF_GROUND, frame.ahead
    return seen, "east" if up.endswith("north") else f"right of the {up}", up


# --------------------------------------------------------------------------------------------------
# ``in_site.json``: where a dive lies in an earlier one, and what speaks for it; also in words.

FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""


def in_site(in_base: InBase, keyframes: KeyframeStore, taken_over: int) -> dict[str, Any]:
    """The content of ``in_site.json`` (docs/formats.md#in-site); ``taken_over``: Gaussians of the
    map that began as the base's."""
    return {
        "format": FORMAT,
        **in_site_numbers(in_base, taken_over),
        "sub_maps": {
            str(sub_map): _place(in_base, sub_map, links, keyframes)
            for sub_map, links in sorted(in_base.by_sub_map().items())
        },
    }


def in_site_numbers(in_base: InBase, taken_over: int) -> dict[str, Any]:
    """The key ``in_site`` of metrics.json, and of /health."""
    first = in_base.first
    return {
        "site": in_base.base.name,
        "state": "found" if in_base.recognised else "looking",
        "first_frame": None if first is None else first.frame,
        "first_s": None if first is None else first.t_ns * 1e-9,
        "looked_up": in_base.looked_up,
        "links": len(in_base.links),
        "refused": in_base.refused,
        "passed_over": in_base.passed_over,
        "taken_over": taken_over,
    }


def in_site_notes(in_base: InBase, keyframes: KeyframeStore, taken_over: int) -> list[str]:
    """What the dive came to in the earlier one, for the user; one sentence each."""
    name = in_base.base.name
    if in_base.first is None:
        return [
            f"nothing of {name} was recognised in {in_base.looked_up} keyframes: the dive is in a "
            "frame of its own, as without --in"
        ]
    first = in_base.first
    notes = [
        f"the dive was recognised in {name} at frame {first.frame} ({first.t_ns * 1e-9:.1f} s), by "
        f"{len(in_base.links)} of {in_base.looked_up} keyframes: its files are in the frame of "
        f"{name}"
    ]
    if taken_over:
        notes.append(
            f"{taken_over} Gaussians of the map began as those of {name}, where this dive saw "
            "their surface"
        )
    sub_maps = {keyframe.sub_map for keyframe in keyframes.keyframes}
    elsewhere = len(sub_maps - set(in_base.by_sub_map()))
    if elsewhere:
        notes.append(
            f"{elsewhere} of {len(sub_maps)} sub-maps were not recognised in {name}: each of them "
            "is in a frame of its own"
        )
    return notes


def _place(
    in_base: InBase, sub_map: int, links: list[BaseLink], keyframes: KeyframeStore
) -> dict[str, Any]:
    frame = in_base.frame(sub_map, WorldFrame.unknown())
    T, covariance = frame.T_nm, in_base.places()[sub_map].covariance
    return {
        "site_sub_map": links[0].base_sub_map,
        "unit": frame.unit,
        "T_site_dive": sim3_to_json(T),
        "sigma": {
            "position_map_units": float(np.sqrt(np.trace(covariance[:3, :3]))),
            "rotation_deg": float(np.degrees(np.sqrt(np.trace(covariance[3:6, 3:6])))),
            "scale": float(np.sqrt(covariance[6, 6])),
        },
        "links": [
            {
                "keyframe": link.keyframe,
                "frame": keyframes[link.keyframe].frame_index,
                "t_s": keyframes[link.keyframe].t_ns * 1e-9,
                "site_keyframe": link.base_keyframe,
                "keypoints": link.inliers,
            }
            for link in links
        ],
    }
