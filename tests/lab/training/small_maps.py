"""Dive folders with a small map: a flat floor of soft colours, and the views that saw it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from aquaflow.dive.map_file import write_map_file
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.recordings.kept_pictures import KeptPictures
from aquaflow.types import Frame
from tests.mapping.mapping_scenes import (
    CAMERA,
    floor,
    path,
    picture,
    renderer,
    settings,
    view_of,
)


def small_dive(folder: Path, seed: int = 0, poses: list[Sim3] | None = None, kept: int = 0) -> Path:
    """A finished dive, as far as its map is concerned; 2 m above the floor. It has kept the
    pictures of the first ``kept`` views."""
    folder.mkdir()
    mapper = Mapper(settings(), renderer(), 0)
    mapper.scene.gaussians = gaussians = floor(columns=80, rows=60, scale=0.02)
    waves = gaussians.means @ torch.tensor([[5.0, 3.0, 4.0], [2.0, 5.0, -4.0], [0.0, 0.0, 0.0]])
    gaussians.parameters["raw_colours"].copy_(raw_colour(0.5 + 0.4 * torch.sin(waves + seed)))
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    pictures = KeptPictures(folder, math.inf)
    for index, T_wc in enumerate(path(6) if poses is None else poses):
        mapper.add_view(view_of(black, T_wc, index))
        if index < kept:
            seen = picture(gaussians, T_wc)
            t_ns = index * 1_000_000_000
            pictures.offer(Frame(index, t_ns, t_ns, seen, CAMERA))
    write_map_file(folder / "map.aqf", mapper)
    return folder
