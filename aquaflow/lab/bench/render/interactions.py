"""How much work a picture holds: the pairs of a pixel and a Gaussian that contribute to it.

A pair counts where alpha is above 1/255 while the pixel's transmittance is above 1e-4: what any
renderer of the contract must blend. Pairs that a renderer looks at in vain are not work done.
"""

from __future__ import annotations

import torch

from aquaflow.render.example_scene import SplatScene
from aquaflow.render.limits import TILE_PX
from aquaflow.render.reference import Footprints, alpha_at, blend_weights, project

FORWARD_FLOP, BACKWARD_FLOP = 30.0, 56.0
"""Floating-point operations of one interaction: estimates from the inner loops of the prototype
that the kernels grew from. They set the scale of every share of the peak, and rank nothing."""


def count_interactions(scene: SplatScene) -> int:
    """Exact, in float64, tile by tile."""
    means, quats, scales, opacities, colours, viewmat = (t.double() for t in scene.inputs)
    gaussians = (means, quats, scales, opacities, colours)
    size = (scene.size.width, scene.size.height)
    with torch.no_grad():
        seen = project(*gaussians, viewmat, scene.K.double(), *size)
        return sum(
            _in_tile(seen, left, top, scene)
            for top in range(0, scene.size.height, TILE_PX)
            for left in range(0, scene.size.width, TILE_PX)
        )


def _in_tile(seen: Footprints, left: int, top: int, scene: SplatScene) -> int:
    corner = seen.centre.new_tensor([left, top])
    end = torch.minimum(corner + TILE_PX, corner.new_tensor([scene.size.width, scene.size.height]))
    near = (seen.centre + seen.extent > corner) & (seen.centre - seen.extent < end)
    touching = torch.nonzero(near.all(1))[:, 0]  # still front to back
    x, y = (torch.arange(int(a), int(b)) + 0.5 for a, b in zip(corner, end, strict=True))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), 2).view(-1, 2).double()
    offset = pixels - seen.centre[touching][:, None]
    alpha = alpha_at(offset, seen.conic[touching], seen.opacity[touching])
    return int((blend_weights(alpha, 0) > 0).sum())
