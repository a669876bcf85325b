"""From encodings to matches of single pixels: coarse cell, then the fine descriptors around it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.prior.compact.network import COARSE, FINE

WINDOW = 6
"""Fine cells searched on either side of where the coarse match points."""


def coarse_at(
    pixels: Tensor,  # [B, 2, h, w] px, coarse matches of the cells' centres
    places: Tensor,  # [B, N, 2] px in the first picture
) -> Tensor:
    """[B, N, 2] px: each pixel moves as the centre of its cell does."""
    height, width = pixels.shape[-2:]
    column = (places[..., 0] / COARSE).long().clamp(0, width - 1)
    row = (places[..., 1] / COARSE).long().clamp(0, height - 1)
    index = (row * width + column)[:, None].expand(-1, 2, -1)
    there = pixels.flatten(2).gather(2, index).mT
    centre = torch.stack([column + 0.5, row + 0.5], -1) * COARSE
    return there + places - centre


def fine_around(
    D_a: Tensor,  # [B, d, H/2, W/2]
    D_b: Tensor,  # [B, d, H/2, W/2]
    places: Tensor,  # [B, N, 2] px in the first picture
    expected: Tensor,  # [B, N, 2] px in the second
) -> tuple[Tensor, Tensor]:
    """[B, N, 2] px, the most alike descriptor near ``expected``, to sub-pixel; [B, N] its product.

    Sub-pixel places come from a parabola through the best product and its neighbours, per axis.
    """
    own = descriptors_at(D_a, places)
    cells, products = window_products(own, D_b, expected, WINDOW)
    side = 2 * WINDOW + 1
    best = products.argmax(2)
    middle = products.gather(2, best[..., None])[..., 0]
    offset = torch.stack(
        [
            _parabola(products, best, middle, best % side, 1, side),
            _parabola(products, best, middle, best // side, side, side),
        ],
        -1,
    )
    found = cells.gather(2, best[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    return (found + 0.5 + offset) * FINE, middle


def window_products(
    own: Tensor,  # [B, N, d] unit
    D: Tensor,  # [B, d, h, w] unit
    expected: Tensor,  # [B, N, 2] px
    reach: int,
) -> tuple[Tensor, Tensor]:
    """[B, N, K, 2] fine cells (column, row) around ``expected`` and [B, N, K] products there.

    Cells beyond the picture have the product -1.
    """
    height, width = D.shape[-2:]
    axis = torch.arange(-reach, reach + 1, device=D.device)
    shift = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).flatten(0, 1)
    cells = (expected / FINE).floor().long()[:, :, None] + shift
    limit = torch.tensor([width, height], device=D.device)
    inside = ((cells >= 0) & (cells < limit)).all(-1)
    held = torch.minimum(cells.clamp_min(0), limit - 1)
    index = (held[..., 1] * width + held[..., 0]).flatten(1)
    batch = torch.arange(len(D), device=D.device)[:, None]
    there = D.flatten(2).mT[batch, index].reshape(*cells.shape[:3], -1)
    products = (there @ own[..., None])[..., 0]
    return cells, torch.where(inside, products, -1.0)


def descriptors_at(
    D: Tensor,  # [B, d, h, w]
    places: Tensor,  # [B, N, 2] px
) -> Tensor:
    """[B, N, d] bilinear, of unit length again."""
    size = torch.tensor(D.shape[:-3:-1], device=D.device) * FINE
    grid = (places / size * 2.0 - 1.0)[:, :, None]
    values = F.grid_sample(D, grid, padding_mode="border", align_corners=False)[..., 0]
    return F.normalize(values, dim=1).mT


def _parabola(
    products: Tensor,  # [B, N, K]
    best: Tensor,  # [B, N]
    middle: Tensor,  # [B, N]
    place: Tensor,  # [B, N] of the best along the axis
    step: int,
    side: int,
) -> Tensor:
    """[B, N] in cells, zero at the window's rim."""
    last = products.shape[2] - 1
    before = products.gather(2, (best - step).clamp_min(0)[..., None])[..., 0]
    after = products.gather(2, (best + step).clamp_max(last)[..., None])[..., 0]
    offset = 0.5 * (before - after) / (before - 2.0 * middle + after).clamp_max(-1e-6)
    return torch.where((place > 0) & (place < side - 1), offset.clamp(-0.5, 0.5), 0.0)
