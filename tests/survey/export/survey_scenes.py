"""A small dive over a ground of known height and colour, as a dive folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from pyproj import Transformer

from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config, MappingConfig
from aquaflow.dive.map_file import write_map_file
from aquaflow.dive.placement import to_geodetic
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame
from tests.mapping.mapping_scenes import gaussians_at, renderer
from tests.metric_scenes import TRONDHEIM, metric_frame

Array = npt.NDArray[np.float64]

SIDE_M = 4.0
SPACING_M = 0.02
"""Of the Gaussians."""
DEPTH_M, ALTITUDE_M = 10.0, 2.0
"""Of the mean ground below the surface; of the cameras above it."""
CAMERA = CameraModel(160, 120, 136.0, 136.0, 80.0, 60.0)
"""2.35 x 1.76 m at the altitude."""
STOPS = (0.6, 1.4, 2.2, 3.0)
"""m north and east, of the cameras."""
LOOKS_DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""R_nc of a camera whose picture has north on top."""
UTM_32 = 32632


def height(
    north: Array,  # [...] m
    east: Array,  # [...] m
) -> Array:
    """m above the mean ground: waves of 0.1 m and a mound of 0.3 m."""
    waves = 0.1 * np.sin(2.5 * north) * np.cos(1.9 * east)
    return waves + 0.3 * np.exp(-((north - 1.2) ** 2 + (east - 2.6) ** 2) / 0.18)


def colour(
    north: Array,  # [...] m
    east: Array,  # [...] m
) -> Array:
    """[..., 3] clean radiance."""
    red = 0.45 + 0.2 * np.sin(5.0 * north)
    green = 0.45 + 0.2 * np.sin(4.0 * east + 1.0)
    blue = 0.45 + 0.2 * np.sin(3.0 * (north + east))
    return np.stack([red, green, blue], axis=-1)


def surveyed(frame: WorldFrame | None = None) -> Mapper:
    """The map of the ground as an ideal survey would make it, in the world of ``frame``."""
    T_mn = (frame or metric_frame()).T_nm.inverse()
    steps = np.arange(0.5 * SPACING_M, SIDE_M, SPACING_M)
    north, east = (each.ravel() for each in np.meshgrid(steps, steps))
    points_n = np.column_stack([north, east, DEPTH_M - height(north, east)])
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    mapper.scene.gaussians = gaussians_at(
        torch.from_numpy(T_mn.apply(points_n)),
        torch.from_numpy(colour(north, east)),
        0.7 * SPACING_M * T_mn.scale,
    )
    blank = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    places = [(x, y) for x in STOPS for y in STOPS]
    for index, (x, y) in enumerate(places):
        T = T_mn @ Sim3(LOOKS_DOWN, np.array([x, y, DEPTH_M - ALTITUDE_M]))
        mapper.views.append(View(index, blank, CAMERA, Sim3(T.R, T.t), 0, robust=False))
    return mapper


def write_survey(folder: Path, mapper: Mapper, frame: WorldFrame | None = None) -> Path:
    """The dive folder of a map in ``frame``."""
    folder.mkdir()
    write_map_file(folder / "map.aqf", mapper)
    write_metric_file(folder, {0: frame or metric_frame()}, main=0)
    write_yaml(folder / "config.yaml", Config().model_dump(mode="json"))
    return folder


def on_utm(
    points_n: Array,  # [N, 3] m
) -> Array:
    """[N, 2] easting and northing of points of n."""
    latitude, longitude = to_geodetic(TRONDHEIM, points_n)
    to_grid = Transformer.from_crs(4326, UTM_32, always_xy=True)
    return np.column_stack(to_grid.transform(longitude, latitude))
