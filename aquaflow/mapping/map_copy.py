"""A copy of what is shown of a map, which goes on being mapped meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.clear_colours import restored_gaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.activation import radiance
from aquaflow.render.transfers import map_out


@dataclass(frozen=True)
class MapCopy:
    """Copies of the shown parts of a map, for any thread."""

    parameters: dict[str, npt.NDArray[np.float32]]
    steps: npt.NDArray[np.int32]
    """[N] optimiser steps of each Gaussian."""
    clear: npt.NDArray[np.float32]
    """[N, 3] without water."""
    water: npt.NDArray[np.float32] | None
    """[6, 3] beta, B_inf, b, B_res, d as the last camera sees it, and the gain of ``clear``."""
    views: list[Sim3]
    """T_wc of the mapped views; the last one is the newest."""


@torch.no_grad()
def copy_map(mapper: Mapper) -> MapCopy:
    """In the mapping thread: a copy; a tenth of a second for 150,000 Gaussians."""
    tensors = mapper.gaussians.parameters
    plain = {name: map_out(tensor) for name, tensor in tensors.items()}
    clear = restored_gaussians(mapper.scene, radiance(tensors["raw_colours"]), mapper.views)
    view = mapper.views[-1]
    water = mapper.scene.water(view)
    rows = None
    if water is not None:
        rows = map_out(torch.cat([water.stack(), mapper.scene.white_gain()[None]]))
    steps = map_out(mapper.optimiser.adam.steps)
    poses = [each.T_wc for each in mapper.views]
    return MapCopy(plain, steps, map_out(clear), rows, poses)
