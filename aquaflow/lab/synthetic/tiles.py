"""Equal tiles with joints between them, filtered to the size of a ray's footprint."""

from __future__ import annotations

import torch

from aquaflow.lab.synthetic.texture import MipAtlas

JOINT_SHARE = 0.05
"""Width of a joint over the edge of a tile."""
JOINT_ALBEDO = 0.24
"""Of the grout."""
TINT = 0.03
"""Standard deviation of the tiles' albedo, from one to the next: one kiln, one batch."""
APART = (67.3, 41.9)
"""Texels between what neighbouring tiles read of the texture, so that their tints differ."""


def lay(
    paint: torch.Tensor,  # [3, N] albedo of the glaze
    texture: MipAtlas,  # noise of unit variance in its first channel
    u: torch.Tensor,  # [N] m on the surface
    v: torch.Tensor,  # [N] m
    footprint: torch.Tensor,  # [N] m, size of the ray on the surface
    edge_m: float,
) -> torch.Tensor:
    """Albedo [3, N] of a surface with tiles."""
    column, row = torch.floor(u / edge_m), torch.floor(v / edge_m)
    tint = texture.mirror(APART[0] * column, APART[1] * row, torch.ones_like(u))[0]
    # Beyond a tile's size the tints average out.
    tint = TINT * tint * (edge_m / footprint.clamp_min(edge_m))
    joint = 1.0 - (1.0 - _joint(u, footprint, edge_m)) * (1.0 - _joint(v, footprint, edge_m))
    return paint * (1.0 + tint) * (1.0 - joint) + JOINT_ALBEDO * joint


def _joint(
    x: torch.Tensor,  # [N]
    footprint: torch.Tensor,  # [N]
    edge_m: float,
) -> torch.Tensor:
    """Share [N] of a footprint around ``x`` that joints across it take."""
    joint = JOINT_SHARE * edge_m
    size = footprint.clamp(1e-6, edge_m)
    from_joint = (torch.remainder(x / edge_m + 0.5, 1.0) - 0.5).abs() * edge_m
    inside = torch.minimum(from_joint + 0.5 * size, torch.full_like(x, 0.5 * joint))
    inside = inside - torch.maximum(from_joint - 0.5 * size, torch.full_like(x, -0.5 * joint))
    return inside.clamp_min(0.0) / size
