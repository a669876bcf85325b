"""Points as a surveyor types them.

- ``120:640,360``: pixel of the mapped picture of frame 120.
- ``1.2,-0.4,9.1``: x, y, z of the map in n.
- ``63.4305N,10.3951E``: latitude and longitude in degrees; the height is the ground's there.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import view_of_frame
from aquaflow.geometry.earth import north_east
from aquaflow.mapping.mapper import Mapper
from aquaflow.survey.export.ortho.ground import Ground
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.picked import PickedPoint, of_map, of_pixel
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.telemetry.world_frame import WorldFrame

_ON_EARTH = re.compile(r"([\d.]+)([NS]),([\d.]+)([EW])")


@dataclass(frozen=True)
class Pixel:
    """A pixel of a mapped picture."""

    frame: int
    u: float
    v: float


@dataclass(frozen=True)
class MapPoint:
    """A point in n."""

    x: float
    y: float
    z: float


@dataclass(frozen=True)
class GeodeticPoint:
    """A point on the earth, degrees."""

    latitude: float
    longitude: float


Asked: TypeAlias = Pixel | MapPoint | GeodeticPoint


def parse_point(text: str) -> Asked:
    """What a text says.

    Raises:
        ArgumentError: it is no point.
    """
    found = _ON_EARTH.fullmatch(text.replace(" ", "").upper())
    try:
        if found is not None:
            latitude, longitude = float(found[1]), float(found[3])
            if latitude <= 90.0 and longitude <= 180.0:
                south, west = found[2] == "S", found[4] == "W"
                return GeodeticPoint(
                    -latitude if south else latitude, -longitude if west else longitude
                )
        frame, _, rest = text.rpartition(":")
        numbers = [float(part) for part in rest.split(",")]
        if all(map(math.isfinite, numbers)):
            if frame and len(numbers) == 2:
                return Pixel(int(frame), *numbers)
            if not frame and len(numbers) == 3:
                return MapPoint(*numbers)
    except ValueError:
        pass
    raise ArgumentError(
        f"{text[:80]!r} is no point; give x,y,z of the map, FRAME:u,v of a picture, or "
        "63.4305N,10.3951E"
    )


def locate(
    asked: list[Asked],
    mapper: Mapper,
    frame: WorldFrame,
    dive: Dive,
    field: HeightField | None,
    ground: Ground | None,
    reach: float,
) -> MeasuredPoints:
    """The points in n, with their errors.

    Args:
        field, ground: are needed by places on the earth alone, in n's unit.
        reach: see :class:`MeasuredPoints`.

    Raises:
        InputError: a point is outside of its picture, of the map, or of the ground.
    """
    picked = [_locate(each, mapper, frame, dive, field, ground) for each in asked]
    return MeasuredPoints(
        np.array([each.place for each in picked]), np.array([each.own for each in picked]),
        np.array([each.shared for each in picked]), reach,
    )  # fmt: skip


def _locate(
    asked: Asked,
    mapper: Mapper,
    frame: WorldFrame,
    dive: Dive,
    field: HeightField | None,
    ground: Ground | None,
) -> PickedPoint:
    if isinstance(asked, Pixel):
        view = view_of_frame(mapper, asked.frame, dive)
        return of_pixel(mapper, frame, view, np.array([asked.u, asked.v]))
    if isinstance(asked, MapPoint):
        return of_map(mapper, frame, np.array([asked.x, asked.y, asked.z]))
    if not frame.georeferenced or frame.origin is None or field is None or ground is None:
        raise InputError(
            "the dive has no place on the earth; give x,y,z of the map or FRAME:u,v of a picture"
        )
    origin = (frame.origin.latitude_deg, frame.origin.longitude_deg)
    [flat] = north_east(np.array([asked.latitude]), np.array([asked.longitude]), origin)
    R_gn = ground.T_gm.R @ frame.T_nm.R.T
    x, y = (R_gn @ np.array([*flat, 0.0]))[:2]
    height, sigma = field.at(np.array([[x, y]]))
    if not np.isfinite(height[0]):
        raise InputError(
            f"the map has no ground at {asked.latitude:g}, {asked.longitude:g} (degrees); give a "
            "place within the survey"
        )
    place = R_gn.T @ np.array([x, y, height[0]])
    up = R_gn.T @ np.array([0.0, 0.0, 1.0])
    # Where on the cell the ground was asked for does not matter to what is read off a chart.
    return PickedPoint(place, (sigma[0] ** 2) * np.outer(up, up), np.zeros((3, 3)))
