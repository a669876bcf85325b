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
    last = torch.tensor([columns - 1, rows - 1], device=low.device)
    first, final = (
        torch.minimum(((edge - 0.5) / TILE_PX).nan_to_num().floor().clamp(min=0), last).long()
        for edge in (low, high)
    )
    return first, final


def touches_active(
    low: Tensor,  # [M, 2] px
    high: Tensor,  # [M, 2] px
    active: Tensor,  # [ceil(H/16), ceil(W/16)] bool
    width: int,
    height: int,
) -> Tensor:
    """[M] bool: whether a box touches an active tile; four reads of a summed-area table each."""
    first, final = tile_box(low, high, width, height)
    table = torch.zeros(active.shape[0] + 1, active.shape[1] + 1, dtype=torch.long)
    table = table.to(active.device)
    table[1:, 1:] = active.long().cumsum(0).cumsum(1)
    (x0, y0), (x1, y1) = first.unbind(1), (final + 1).unbind(1)
    return table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0
