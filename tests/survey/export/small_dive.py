"""A dive folder with a known answer: a flat floor, three frames over it, and their recording."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config, MappingConfig
from aquaflow.dive.map_file import write_map_file
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.contract import radiance
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import Origin, WorldFrame
from tests.mapping.mapping_scenes import CAMERA, floor, pose, renderer, view_of

THICKNESS, SPREAD = 0.01, 0.06
"""Standard deviations of each Gaussian across the floor and along it, map units."""
FRAMES = (0, 2, 4)
POSES = {
    0: pose((0.0, 0.0, 0.0)),
    2: pose((0.2, 0.1, -0.1), (0.02, -0.03, 0.05)),
    4: pose((-0.2, 0.05, 0.1), (-0.03, 0.02, -0.04)),
}
WATER = ((0.4, 0.2, 0.15), (0.1, 0.25, 0.3), (0.4, 0.3, 0.2))

SCALE, SHIFT = 1.5, (10.0, 20.0, 0.5)
"""From map units to metres, and the place of the map's origin in n."""
ORIGIN = Origin(latitude_deg=59.3, longitude_deg=10.4, source="test", sigma_m=1.0)


def north_up_frame() -> WorldFrame:
    """Metric and on the earth: the first camera looks straight down, its picture's top is north."""
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return WorldFrame(
        Sim3(R, np.array(SHIFT), SCALE), np.eye(7) * 1e-4, metric=True, level=True,
        north="true north", depth_known=True, origin=ORIGIN,
    )  # fmt: skip


def small_mapper() -> Mapper:
    """The floor in its water, and the views, whose pictures are blank."""
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    mapper.scene.gaussians = floor(columns=40, rows=30, scale=SPREAD)
    parameters = mapper.scene.gaussians.parameters
    with torch.no_grad():
        parameters["log_scales"][:, 2] = math.log(THICKNESS)
        parameters["raw_colours"].copy_(raw_colour(_waves(parameters["means"])))
    mapper.medium.set_water(*(torch.tensor(values) for values in WATER))
    blank = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    mapper.views = [view_of(blank, POSES[index], index) for index in FRAMES]
    return mapper


def _waves(
    means: torch.Tensor,  # [N, 3]
) -> torch.Tensor:
    """[N, 3] colours that change over half a unit: neighbours blend in a picture."""
    x, y, _ = means.T
    phases = (9.0 * x + 2.0 * y, 8.0 * y - 3.0 * x, 6.0 * x + 7.0 * y + 1.0)
    return 0.5 + 0.35 * torch.sin(torch.stack(phases, dim=1))


def write_small_dive(folder: Path, frame: WorldFrame | None = None) -> Mapper:
    """The dive in ``folder``, which is made; in map units unless a ``frame`` says more."""
    folder.mkdir()
    mapper = small_mapper()
    write_map_file(folder / "map.aqf", mapper)
    source = {"source": {"width": CAMERA.width}}
    write_yaml(folder / "config.yaml", Config.model_validate(source).model_dump(mode="json"))
    if frame is not None:
        write_metric_file(folder, {0: frame}, main=0)
    T_nm = (frame or WorldFrame.unknown()).T_nm
    for name, share in (("map_clear", 1.0), ("map", 0.5)):
        write_ply(folder / f"{name}.ply", _splats(mapper, share).transform(T_nm))
    return mapper


def _splats(mapper: Mapper, share: float) -> PlyGaussians:
    plain = mapper.scene.gaussians.parameters
    return PlyGaussians(
        plain["means"].numpy(), plain["quats"].numpy(), plain["log_scales"].exp().numpy(),
        plain["opacity_logits"][:, 0].sigmoid().numpy(),
        share * radiance(plain["raw_colours"]).numpy(),
    )  # fmt: skip


def write_recording(folder: Path, mapper: Mapper) -> dict[int, npt.NDArray[np.uint8]]:
    """Five pictures in ``folder``, which is made: those of the mapped frames, drawn; by index."""
    folder.mkdir()
    drawn = {v.frame_index: to_bytes(mapper.show(v).image.numpy()) for v in mapper.views}
    for index in range(5):
        picture = drawn.get(index, drawn[0])
        cv2.imwrite(str(folder / f"{index:06d}.png"), picture[..., ::-1])
    return drawn
