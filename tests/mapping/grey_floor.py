"""A map of a grey floor in water, as a camera sees it whose white balance has a cast."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.config import MappingConfig
from aquaflow.mapping.gaussians import raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import picture_out
from aquaflow.water.white_balance import Rgb, WhiteBalance
from tests.mapping.mapping_scenes import CAMERA, floor, pose, renderer, view_of

WATER = ((0.3, 0.15, 0.1), (0.05, 0.15, 0.2), (0.4, 0.3, 0.2))
CAST = (0.5, 1.0, 1.25)
"""What the camera's white balance makes of grey."""
BLANK = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)


def mapped(choice: str = "camera", light: Rgb | None = None) -> Mapper:
    """A floor of greys in water that a camera with a cast looks at, or a camera without by light of
    that colour."""
    config = MappingConfig.model_validate({"medium": {"white_balance": choice}})
    mapper = Mapper(config, renderer(), seed=0)
    mapper.scene.gaussians = floor(columns=40, rows=30, scale=0.06)
    greys = 0.15 + 0.5 * torch.rand(1200, 1, generator=torch.Generator().manual_seed(1))
    mapper.gaussians.parameters["raw_colours"] = raw_colour(
        greys * torch.tensor(light or (1.0, 1.0, 1.0))
    )
    mapper.medium.set_water(*(torch.tensor(values) for values in WATER))
    mapper.scene.balance = WhiteBalance(
        1.9, (0.4, 0.4, 0.4), (0.9, 1.0, 1.05) if light else CAST, 0.1
    )  # fmt: skip
    places = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0))
    blank = [view_of(BLANK, pose(at), index) for index, at in enumerate(places)]
    pictures = [to_bytes(picture_out(mapper.show(view).image)) for view in blank]
    mapper.views = [
        view_of(picture, pose(at), index)
        for index, (picture, at) in enumerate(zip(pictures, places, strict=True))
    ]
    return mapper
