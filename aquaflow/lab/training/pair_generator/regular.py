"""Albedo that repeats itself: tiled floors, brickwork and nets, unlike only by their dirt.

Their cells are alike, so that only what lies around a cell says which one it is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.noise import spectral, stamp

CELLS = (3, 14)
"""Half the number of cells along a period; a whole even number of them keeps it periodic."""
JOINT = (0.04, 0.2)
"""Width of a joint or a twine, as a share of its cell."""
SAG = 0.15
"""Deviation of a net's displacement, in cells."""
NETS = 0.35
"""Share of nets; the others are tiles and bricks."""


def regular_albedo(draw: Draw, batch: int, size: int) -> Tensor:
    """[B, 3, size, size] in [0, 1], periodic."""
    count = 2.0 * (draw.whole(batch, 1, 1, below=CELLS[1] - CELLS[0]) + CELLS[0])
    is_net = draw.chance(NETS, batch, 1, 1)
    u, v = _places(draw, count, is_net, size)
    joint = draw.log_uniform(batch, 1, 1, low=JOINT[0], high=JOINT[1])
    soft = count / size
    lines = torch.maximum(_line(u, joint, soft), _line(v, joint, soft))
    tile = _cell_values(draw, u, v, count)
    dirt = spectral(draw, size, draw.uniform(batch, low=1.2, high=2.6))
    dirt = 1.0 + draw.log_uniform(batch, 1, 1, low=0.02, high=0.25) * dirt
    colours = draw.uniform(2, batch, 3, 1, 1, low=0.05, high=0.9)
    colours = colours.mean(2, keepdim=True).lerp(colours, draw.uniform(batch, 1, 1, 1))
    # Behind a net there is open water or a dim background, and nothing that belongs to a cell.
    background = torch.where(is_net, 0.3 * dirt, tile * dirt)[:, None]
    result = (colours[0] * background).lerp(colours[1] * dirt[:, None], lines[:, None])
    growth = stamp(
        draw,
        size,
        draw.log_uniform(batch, low=1e-5, high=3e-4),
        draw.log_uniform(batch, low=2.0, high=9.0),
        torch.zeros(batch, device=draw.device),
    )[:, None]
    thing = draw.uniform(batch, 3, 1, 1, low=0.05, high=0.7)
    return result.lerp(thing * dirt[:, None], growth).clamp(0.01, 1.0)


def _places(
    draw: Draw,
    count: Tensor,  # [B, 1, 1]
    is_net: Tensor,  # [B, 1, 1] bool
    size: int,
) -> tuple[Tensor, Tensor]:
    """[B, size, size] along and across, in cells: straight, every second row shifted by half a
    cell, or for nets along the diagonals and sagging."""
    batch = len(count)
    axis = (torch.arange(size, device=draw.device) + 0.5) / size
    x = (axis[None, None] * count).expand(-1, size, -1)
    y = (axis[None, :, None] * count).expand(-1, -1, size)
    brick = draw.chance(0.3, batch, 1, 1) * 0.5
    straight = (x + brick * (y.floor() % 2.0), y)
    sag = [SAG * spectral(draw, size, torch.full((batch,), 3.5, device=draw.device)) for _ in "uv"]
    diagonal = draw.chance(0.5, batch, 1, 1)
    net = (
        torch.where(diagonal, x + y, x) + sag[0],
        torch.where(diagonal, x - y, y) + sag[1],
    )
    return torch.where(is_net, net[0], straight[0]), torch.where(is_net, net[1], straight[1])


def _line(
    place: Tensor,  # [B, n, n] in cells
    width: Tensor,  # [B, 1, 1] in cells
    soft: Tensor,  # [B, 1, 1] cells to a texel
) -> Tensor:
    """[B, n, n] in [0, 1], 1 on the cells' borders."""
    away = 0.5 - (place - place.floor() - 0.5).abs()
    return ((0.5 * width - away) / soft + 0.5).clamp(0.0, 1.0)


def _cell_values(
    draw: Draw,
    u: Tensor,  # [B, n, n]
    v: Tensor,  # [B, n, n]
    count: Tensor,  # [B, 1, 1]
) -> Tensor:
    """[B, n, n] brightness of each cell: nearly alike, a few of another glaze."""
    batch, most = len(count), 2 * CELLS[1]
    shade = 1.0 + draw.normal(batch, most * most) * draw.uniform(batch, 1, high=0.06)
    other = draw.uniform(batch, most * most) < draw.uniform(batch, 1, high=0.12)
    shade = torch.where(other, shade * draw.uniform(batch, 1, low=0.4, high=1.5), shade)
    column, row = ((x.floor() % count).long().clamp(0, most - 1) for x in (u, v))
    return shade.gather(1, (row * most + column).flatten(1)).view_as(u)
