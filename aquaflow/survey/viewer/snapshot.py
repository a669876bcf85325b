"""The copy of a map that the live viewer shows; it loads torch, as the map does."""

from __future__ import annotations

import torch

from aquaflow.mapping.clear_colours import restored_gaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.activation import radiance
from aquaflow.render.transfers import map_out
from aquaflow.survey.viewer.copies import MapCopy


@torch.no_grad()
def copied(mapper: Mapper) -> MapCopy:
    """In the mapping thread: a copy; a tenth of a second for 150,000."""
    tensors = mapper.gaussians.parameters
    plain = {name: map_out(tensor) for name, tensor in tensors.items()}
    clear = restored_gaussians(mapper.scene, radiance(tensors["raw_colours"]), mapper.views)
    view = mapper.views[-1]
    water = mapper.scene.water(view)
    rows = None
    if water is not None:
        rows = map_out(torch.cat([water.stacked(), mapper.scene.white_gain()[None]]))
    steps = map_out(mapper.optimiser.adam.steps)
    poses = [each.T_wc for each in mapper.views]
    return MapCopy(plain, steps, map_out(clear), rows, poses)
