"""Copies of a map for the live viewer, made in the thread that owns the map."""

from __future__ import annotations

import torch

from aquaflow.mapping.clear_colours import restored_gaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.transfers import map_out
from aquaflow.render.activation import radiance
from aquaflow.viewer.copies import MapCopy


@torch.no_grad()
def copied(mapper: Mapper) -> MapCopy:
    """In the mapping thread: a copy, and two colours; a tenth of a second for 150,000."""
    tensors = mapper.gaussians.parameters
    plain = {name: map_out(tensor) for name, tensor in tensors.items()}
    clear = radiance(mapper.gaussians.parameters["raw_colours"])
    seen = clear
    view = mapper.views[-1]
    water = mapper.scene.water(view)
    if water is not None:
        z = torch.linalg.vector_norm(mapper.gaussians.means - view.centre(), dim=-1)
        seen = clear * water.transmission(z) + water.backscatter(z)
    steps = map_out(mapper.optimiser.adam.steps)
    clear = restored_gaussians(mapper.scene, clear, mapper.views)
    return MapCopy(plain, steps, map_out(seen), map_out(clear))
