"""The fallback renderer: torch only, batches of tiles, for machines without a compiler.

Correct and slow: every Gaussian of a tile is evaluated at every pixel of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from aquaflow.render.contract import Rendering, check_inputs
from aquaflow.render.reference import Footprints, alpha_at, blend_weights, project

TILE_PX = 16

BATCH_ELEMENTS = 4_000_000
"""Gaussian-pixel pairs held at once; backward recomputes each batch instead of keeping them all."""


class TileRenderer:
    """Tiles as a batch dimension, padded to the longest list of the batch."""

    name = "tiles"
    isa = "torch"

    def __init__(self, threads: int | None = None) -> None:
        """``threads`` is for reports: torch's own setting decides."""
        self.threads = threads if threads is not None else torch.get_num_threads()

    def __call__(
        self,
        means: Tensor,  # [N, 3] m, world
        quats: Tensor,  # [N, 4] wxyz
        scales: Tensor,  # [N, 3] m
        opacities: Tensor,  # [N]
        colours: Tensor,  # [N, C]
        viewmat: Tensor,  # [4, 4] world -> camera
        K: Tensor,  # [3, 3] px
        width: int,
        height: int,
    ) -> Rendering:
        """Draw as the contract says, in the dtype of ``means``."""
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height)
        dtype = means.dtype
        colours = colours.to(dtype)
        gaussians = (means, quats.to(dtype), scales.to(dtype), opacities.to(dtype), colours)
        camera = (viewmat.to(dtype), K.detach().to(dtype))
        footprints = project(*gaussians, *camera, width, height)
        drawn = _draw(footprints, colours, width, height)
        visible, radius_px = footprints.scatter(len(means))
        return Rendering(drawn[..., :-1], drawn[..., -1], visible, radius_px)


@dataclass(frozen=True)
class _TileLists:
    """For every tile, row by row, its footprints front to back."""

    footprint: Tensor  # [L] long
    start: list[int]  # [tiles + 1]
    tiles_x: int
    tiles_y: int


def _tile_lists(footprints: Footprints, width: int, height: int) -> _TileLists:
    """Pairs of footprints and tiles that their boxes touch."""
    tiles_x, tiles_y = -(-width // TILE_PX), -(-height // TILE_PX)
    last = torch.tensor([tiles_x - 1, tiles_y - 1], device=footprints.centre.device)
    with torch.no_grad():
        low = ((footprints.centre - footprints.extent) / TILE_PX).floor().clamp(min=0)
        low = torch.minimum(low, last).long()
        high = ((footprints.centre + footprints.extent) / TILE_PX).floor().clamp(min=0)
        high = torch.minimum(high, last).long()
        size = high - low + 1
        count = size[:, 0] * size[:, 1]
        footprint = torch.arange(len(count), device=count.device).repeat_interleave(count)
        within = torch.arange(len(footprint), device=count.device)
        within = within - (count.cumsum(0) - count)[footprint]
        x = low[footprint, 0] + within % size[footprint, 0]
        y = low[footprint, 1] + within // size[footprint, 0]
        tile = y * tiles_x + x
        tile, by_tile = torch.sort(tile, stable=True)  # stable: the lists stay in depth order
        per_tile = torch.bincount(tile, minlength=tiles_x * tiles_y)
        start = [0, *per_tile.cumsum(0).tolist()]
    return _TileLists(footprint[by_tile], start, tiles_x, tiles_y)


def _batches(lists: _TileLists) -> list[tuple[int, int, int]]:
    """Runs of tiles [first, last) with their longest list, each within BATCH_ELEMENTS."""
    runs: list[tuple[int, int, int]] = []
    first, longest = 0, 0
    for tile in range(lists.tiles_x * lists.tiles_y):
        length = lists.start[tile + 1] - lists.start[tile]
        elements = (tile + 1 - first) * max(longest, length) * TILE_PX * TILE_PX
        if tile > first and elements > BATCH_ELEMENTS:
            runs.append((first, tile, longest))
            first, longest = tile, 0
        longest = max(longest, length)
    return [*runs, (first, lists.tiles_x * lists.tiles_y, longest)]


def _draw(footprints: Footprints, colours: Tensor, width: int, height: int) -> Tensor:
    """[H, W, C + 1]: premultiplied colours, then alpha."""
    lists = _tile_lists(footprints, width, height)
    opaque = torch.ones_like(colours[:, :1])
    layers = torch.cat([colours, opaque], 1)[footprints.index]
    drawn: list[Tensor] = []
    for first, last, longest in _batches(lists):
        slots, filled = _padded(lists, first, last, longest, layers.device)
        corner = _tile_corners(first, last, lists.tiles_x, layers)
        arguments = (footprints.centre, footprints.conic, footprints.opacity, layers)
        drawn.append(
            checkpoint(_draw_batch, *arguments, slots, filled, corner, use_reentrant=False)
        )
    grid = torch.cat(drawn).view(lists.tiles_y, lists.tiles_x, TILE_PX, TILE_PX, -1)
    image = grid.transpose(1, 2).reshape(lists.tiles_y * TILE_PX, lists.tiles_x * TILE_PX, -1)
    return image[:height, :width]


def _padded(
    lists: _TileLists, first: int, last: int, longest: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """[T, longest] footprint per slot, and whether the slot is filled."""
    start = torch.tensor(lists.start[first:last], device=device)[:, None]
    end = torch.tensor(lists.start[first + 1 : last + 1], device=device)[:, None]
    at = start + torch.arange(longest, device=device)
    filled = at < end
    return lists.footprint[torch.where(filled, at, 0)] if longest else at, filled


def _tile_corners(first: int, last: int, tiles_x: int, like: Tensor) -> Tensor:
    """[T, 2] px."""
    tile = torch.arange(first, last, device=like.device)
    return TILE_PX * torch.stack([tile % tiles_x, tile // tiles_x], 1).to(like.dtype)


def _draw_batch(
    centre: Tensor,  # [M, 2] px
    conic: Tensor,  # [M, 3]
    opacity: Tensor,  # [M]
    layers: Tensor,  # [M, C + 1]
    slots: Tensor,  # [T, L]
    filled: Tensor,  # [T, L]
    corner: Tensor,  # [T, 2] px
) -> Tensor:
    """[T, TILE_PX^2, C + 1]."""
    step = torch.arange(TILE_PX, dtype=centre.dtype, device=centre.device) + 0.5
    pixels = torch.stack(torch.meshgrid(step, step, indexing="xy"), 2).view(-1, 2)
    offset = (corner[:, None] + pixels)[:, None] - centre[slots][:, :, None]
    faint = torch.zeros((), dtype=opacity.dtype, device=opacity.device)
    alpha = alpha_at(offset, conic[slots], torch.where(filled, opacity[slots], faint))
    return torch.einsum("tlp,tlc->tpc", blend_weights(alpha, 1), layers[slots])
