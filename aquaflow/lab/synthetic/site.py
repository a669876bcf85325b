"""Where a dive goes: its relief and objects, and the path over them. Nothing here is rendered."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import rays_of_pixels
from aquaflow.geometry.port import port_of
from aquaflow.lab.synthetic import objects, pool
from aquaflow.lab.synthetic import path as paths
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.mounting import mountings_of
from aquaflow.lab.synthetic.placement import place_objects
from aquaflow.lab.synthetic.planted import placed_shapes
from aquaflow.lab.synthetic.radiance import TEXELS_PER_CELL
from aquaflow.lab.synthetic.relief import Area, Relief
from aquaflow.lab.synthetic.streams import stream
from aquaflow.lab.synthetic.terrain import build_relief
from aquaflow.lab.synthetic.ways import way_of

Array: TypeAlias = npt.NDArray[np.float64]

TEXEL_PX = 0.6
"""Size of a texel of the floor in pixels at the nearest usual range: sharp there and beyond."""
TEXELS_MOST = 14e6
"""Keeps the memory that a dive is made in at about 1.5 GB."""

LOOKS_PER_S = 4.0
"""At 30 degrees/s, 8 degrees from one look at the floor to the next."""


@dataclass(frozen=True)
class SurveySite:
    """What a dive passes over, and how it passes."""

    relief: Relief
    shapes: list[objects.Solid]
    crests: npt.NDArray[np.float32]
    """[rows, columns] m up, the relief with the tops of the shapes, at the relief's cells."""
    path: paths.Path
    motion: TrueBodyMotion


def camera_of(config: SyntheticConfig) -> CameraModel:
    """The calibrated camera of a dive."""
    focal, wide = config.focal_px, config.lens == "fisheye"
    return CameraModel(
        config.width,
        config.height,
        focal,
        focal,
        config.width / 2.0,
        config.height / 2.0,
        distortion_model="fisheye" if wide else "none",
        distortion=(0.0, 0.0, 0.0, 0.0) if wide else (),
        port=port_of(config.port),
    )


def site_of(config: SyntheticConfig, least_cell_m: float = 0.0) -> SurveySite:
    """The site of a dive.

    Cells of ``least_cell_m`` that are larger than the pictures need make another relief with the
    same statistics: the finest shapes are missing, and the objects lie elsewhere.
    """
    home = config.home
    around = way_of(home).points
    low, high = _seen_area(home, paths.plan_path(home, stream(home.seed, "sway")))
    low, high = low - (home.margin_m or 0.0), high + (home.margin_m or 0.0)
    texel = max(
        TEXEL_PX * (home.altitude_m - 0.2) / home.focal_px,
        math.sqrt(float(np.prod(high - low)) / TEXELS_MOST),
    )
    area = Area.around(low, high, max(texel * TEXELS_PER_CELL, least_cell_m))
    relief = build_relief(home.scene, area, around, stream(home.seed, "terrain"))
    shapes = place_objects(home.scene, relief, around, stream(home.seed, "objects"))
    shapes += placed_shapes(config.placed, relief)
    # A net hangs where the floor of other scenes is; what is behind it is not followed.
    followed = np.zeros(area.shape, np.float32) if config.scene == "net" else relief.height
    below = area.sample(followed, way_of(config).points)
    path = paths.plan_path(config, stream(config.seed, "sway"), below)
    motion = TrueBodyMotion(path, mountings_of(config))
    return SurveySite(relief, shapes, objects.casters(relief, shapes), path, motion)


def _seen_area(config: SyntheticConfig, flat: paths.Path) -> tuple[Array, Array]:
    """Corners [2] (m, survey frame) of the floor that the dive sees."""
    if config.scene == "pool":
        return pool.corners(way_of(config).points)
    looks = 65
    if config.turns:  # the view sweeps over the corners of the way
        looks = max(looks, math.ceil(LOOKS_PER_S * config.duration_s))
    t = np.linspace(0.0, config.duration_s, looks)
    camera = camera_of(config)
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], float)
    rays = rays_of_pixels(camera, corners)[1]
    directions = np.einsum("nij,kj->nki", flat.R_ws.T @ flat.R_wc(t), rays)
    centre = flat.centre_s(t)[:, None, :]
    # Relief makes rays travel further than over a flat floor; a metre more than the camera's
    # height covers hollows.
    drop = np.maximum(directions[..., 2], 1e-3)
    reach = np.minimum((1.0 - centre[..., 2]) / drop, config.max_range_m)
    points = (centre + reach[..., None] * directions)[..., :2].reshape(-1, 2)
    points = np.vstack([points, centre[:, 0, :2]])
    return points.min(axis=0) - 0.5, points.max(axis=0) + 0.5
