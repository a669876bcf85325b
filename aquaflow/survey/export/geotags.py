"""Where each picture was taken, as programs that align pictures take it in: two tables.

Both lay places on the dive's UTM grid and give the camera's attitude as Metashape and OpenDroneMap
do: yaw, pitch and roll of (top of the picture, right of it, viewing direction) against north, east
and down, applied in this order. Zero is a camera that looks straight down with north on top, and a
pitch of 90 degrees one that looks level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.base.storage.table import text_of_number, write_table
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import UPRIGHT_FROM_DOWN, UtmGrid, grid_of, to_geodetic
from aquaflow.dive.restored import picture_name
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

COLUMNS = (
    "file", "easting_m", "northing_m", "height_m", "sigma_horizontal_m", "sigma_vertical_m",
    "yaw_deg", "pitch_deg", "roll_deg", "latitude_deg", "longitude_deg",
)  # fmt: skip
"""Of the CSV."""
DEGREES, OTHERS = 9, 4
"""Decimals of latitude and longitude, and of metres and angles: 0.1 mm."""
BODY_FROM_CAMERA = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Top, right, viewing direction from right, down, forward."""


@dataclass(frozen=True)
class Geotags:
    """Pictures with a pose in a sub-map that lies on the earth, in the recording's order."""

    epsg: int
    """Of eastings and northings."""
    height_zero: str
    """What a height of 0 is, in words."""
    files: Sequence[str]
    """[N] names of the pictures: the recording's own where it is pictures, else those that exports
    give them."""
    places: Array
    """[N, 3] easting, northing, height of the camera's centre, m."""
    sigmas: Array
    """[N, 2] 1 sigma of the place, in the horizontal direction that is known least and along the
    vertical, m: that of the frame and of its origin."""
    angles: Array
    """[N, 3] yaw (clockwise from the grid's north), pitch and roll, degrees."""
    geodetic: Array
    """[N, 2] latitude and longitude, degrees, WGS 84."""

    def __len__(self) -> int:
        return len(self.files)


def read_geotags(dive: Dive) -> Geotags:
    """The geotags of a finished dive.

    Raises:
        InputError: the largest sub-map has no place on the earth, or a file is missing or damaged.
    """
    frame = dive.frame
    grid = grid_of(frame)
    if grid is None:
        raise InputError(f"{dive} has no place on a map's grid: {missing_place(frame)}")
    poses, sub_maps = dive.trajectory, dive.sub_map_of_pose
    named = [
        (row.source if "#" not in row.source else picture_name(row.index))
        for row in (dive.frames[number] for number in dive.frame_of_pose)
    ]
    count = len(poses)
    places, sigmas, angles = (np.full((count, size), np.nan) for size in (3, 2, 3))
    geodetic = np.full((count, 2), np.nan)
    for number in set(sub_maps.tolist()):
        own, members = dive.frame_of(number), np.flatnonzero(sub_maps == number)
        if not own.georeferenced or own.origin is None:
            continue
        positions = poses.positions[members]
        laid = UtmGrid(own.origin, grid.epsg)
        places[members] = np.column_stack([laid.places(positions), -positions[:, 2]])
        sigmas[members] = [_sigmas(own, position) for position in positions]
        turn = laid.axes(positions.mean(axis=0))[0]
        angles[members] = attitudes(turn, poses.R_wc[members])
        geodetic[members] = np.column_stack(to_geodetic(own.origin, positions))
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    return Geotags(
        grid.epsg, "the water surface" if frame.depth_known else "the dive's start",
        [named[each] for each in known],
        places[known], sigmas[known], angles[known], geodetic[known],
    )  # fmt: skip


def missing_place(frame: WorldFrame) -> str:
    """Why there is no grid, and what would give one."""
    if frame.georeferenced:
        return "UTM ends near the poles"
    lacks = [
        name
        for name, known in (
            ("metres", frame.metric),
            ("gravity", frame.level),
            ("true north", frame.north == "true north"),
            ("a position", frame.origin is not None),
        )
        if not known
    ]
    return f"it lacks {', '.join(lacks)}; map it with the vehicle's positions (--telemetry)"


def _sigmas(
    frame: WorldFrame,
    position: Array,  # [3] n
) -> tuple[float, float]:
    covariance = frame.position_covariance(position)
    horizontal = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    origin = 0.0 if frame.origin is None else frame.origin.sigma_m
    return float(np.sqrt(horizontal + origin**2)), float(np.sqrt(covariance[2, 2]))


def attitudes(
    turn: Array,  # [3, 3] from true east, north, up to those of the grid
    R_nc: Array,  # [N, 3, 3] from the camera to true north, east, down
) -> Array:
    """[N, 3] yaw, pitch and roll, degrees."""
    to_grid = UPRIGHT_FROM_DOWN.T @ turn @ UPRIGHT_FROM_DOWN
    R = to_grid @ R_nc @ BODY_FROM_CAMERA.T
    yaw = np.degrees(np.arctan2(R[:, 1, 0], R[:, 0, 0])) % 360.0
    pitch = np.degrees(np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0)))
    roll = np.degrees(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    return np.column_stack([yaw, pitch, roll])


def write_geotags(path: Path, tags: Geotags) -> None:
    """A CSV with a head, COLUMNS, as Metashape imports it into its reference.

    Raises:
        InputError: the file cannot be written.
    """
    metres = np.hstack([tags.places, tags.sigmas, tags.angles])
    rows = [
        [name, *_texts(numbers, OTHERS), *_texts(place, DEGREES)]
        for name, numbers, place in zip(tags.files, metres, tags.geodetic, strict=True)
    ]
    write_table(path, [COLUMNS, *rows])


def write_geo_txt(path: Path, tags: Geotags) -> None:
    """OpenDroneMap's image geolocation file (its documentation, "Image Geolocation Files"): the
    grid, then name, place, angles and sigmas of each picture with spaces between.

    Raises:
        InputError: a name has a space in it, or the file cannot be written.
    """
    for name in tags.files:
        if len(name.split()) != 1:
            raise InputError(
                f"OpenDroneMap's table cannot hold the name {name!r} with its spaces; export "
                "geotags, or rename the pictures and map them again"
            )
    numbers = np.hstack([tags.places, tags.angles, tags.sigmas])
    lines = [f"EPSG:{tags.epsg}"]
    lines += [
        " ".join([name, *_texts(row, OTHERS)])
        for name, row in zip(tags.files, numbers, strict=True)
    ]
    with atomic_write(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode("utf-8"))


def _texts(
    numbers: Array,  # [N]
    decimals: int,
) -> list[str]:
    return [text_of_number(number, decimals) for number in numbers]
