"""The activity mask: which tiles of a picture are drawn, over pixels and over footprints."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.render.contract import TILE_PX, tile_grid


def active_pixels(
    active: Tensor,  # [ceil(H/16), ceil(W/16)] bool
    width: int,
    height: int,
) -> Tensor:
    """[H, W] bool: whether the tile of a pixel is active."""
    rows = active.repeat_interleave(TILE_PX, 0)[:height]
    return rows.repeat_interleave(TILE_PX, 1)[:, :width]


def tile_box(
    low: Tensor,  # [M, 2] px
    high: Tensor,  # [M, 2] px
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """First and last tile (column, row) [M, 2] whose pixel centres each box reaches.

    Clamped to the picture. As in the kernels, a box in the gap between the centres of two tiles
    counts for the first.
    """
    rows, columns = tile_grid(width, height)
    first, final = (
        torch.stack([_tile_of(x, columns), _tile_of(y, rows)], dim=1)
        for x, y in (low.unbind(1), high.unbind(1))
    )
    return first, final


def _tile_of(
    edge: Tensor,  # [M] px
    tiles: int,
) -> Tensor:
    """[M] the tile that an edge reaches, of those along one axis."""
    return ((edge - 0.5) / TILE_PX).nan_to_num().floor().clamp(0, tiles - 1).long()


def touches_active(
    low: Tensor,  # [M, 2] px
    high: Tensor,  # [M, 2] px
    active: Tensor,  # [ceil(H/16), ceil(W/16)] bool
    width: int,
    height: int,
) -> Tensor:
    """[M] bool: whether a box touches an active tile; four reads of a summed-area table each."""
    first, final = tile_box(low, high, width, height)
    size = (active.shape[0] + 1, active.shape[1] + 1)
    table = torch.zeros(size, dtype=torch.long, device=active.device)
    table[1:, 1:] = active.long().cumsum(0).cumsum(1)
    (x0, y0), (x1, y1) = first.unbind(1), (final + 1).unbind(1)
    return table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0
