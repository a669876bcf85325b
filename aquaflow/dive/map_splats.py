"""The Gaussians of a map as they leave it: plain, in numpy."""

from __future__ import annotations

import torch

from aquaflow.dive.ply import PlyGaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.activation import radiance
from aquaflow.render.transfers import map_out


@torch.no_grad()
def splats_of(mapper: Mapper) -> PlyGaussians:
    """Copies of all Gaussians in the map's frame and unit, in colours without water.

    With a decoder, each Gaussian as the mapped view nearest to it sees it.
    """
    plain = mapper.scene.bake_parameters(mapper.views)
    return PlyGaussians(
        means=map_out(plain["means"]),
        wxyz=map_out(torch.nn.functional.normalize(plain["quats"], dim=-1)),
        scales=map_out(torch.exp(plain["log_scales"])),
        opacities=map_out(torch.sigmoid(plain["opacity_logits"][:, 0])),
        colours=map_out(radiance(plain["raw_colours"])),
    )
