"""Albedo of floors and structures, with a pyramid so that nothing flickers with distance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.noise import spectral, stamp

LEVELS = 7
"""Of the pyramid; the coarsest has 1/64 of the texels along a side."""
SHARPNESS = 0.7
"""Share of a pixel's width that is averaged: lenses are sharper than a full pixel's mean."""


@dataclass(frozen=True)
class Atlas:
    """Pyramids of several periodic textures in one picture, so that a lookup is one gather."""

    picture: Tensor
    """[B, 3, rows, columns]; each level has its first row and column once more"""
    size: int
    """Texels along a side of the finest level."""
    row: Tensor
    """[LEVELS] first row of each level."""

    @property
    def width(self) -> int:
        """Columns that one texture takes."""
        return self.size + 1

    def albedo(
        self,
        places: Tensor,  # [B, N, 2] in periods
        footprint: Tensor,  # [B, N] periods that a pixel covers
        material: Tensor,  # [B, N] int64, which texture
    ) -> Tensor:
        """[B, 3, N] trilinear."""
        level = torch.log2((footprint * self.size * SHARPNESS).clamp_min(1.0))
        level = level.clamp_max(LEVELS - 1.001)
        fine = level.floor()
        near = self._level(places, fine.long(), material)
        far = self._level(places, fine.long() + 1, material)
        return near + (far - near) * (level - fine)[:, None]

    def _level(
        self,
        places: Tensor,  # [B, N, 2] in periods
        level: Tensor,  # [B, N] int64
        material: Tensor,  # [B, N] int64
    ) -> Tensor:
        scale = torch.exp2(level.float())[..., None]
        # The mean of 2^l texels lies at their middle, not at the first of them.
        places = places - (scale - 1.0) / (2.0 * self.size)
        inside = (places - places.floor()) * (self.size / scale)
        x = inside[..., 0] + (material * self.width).float()
        y = inside[..., 1] + self.row.to(level.device)[level].float()
        rows, columns = self.picture.shape[-2:]
        grid = torch.stack([x / (columns - 1), y / (rows - 1)], -1) * 2.0 - 1.0
        return F.grid_sample(self.picture, grid[:, :, None], mode="bilinear", align_corners=True)[
            ..., 0
        ]


def atlas(
    textures: list[Tensor],  # each [B, 3, n, n] periodic
) -> Atlas:
    """The pyramids of all textures, side by side."""
    size = textures[0].shape[-1]
    columns = []
    for texture in textures:
        level, stack = texture, []
        for _ in range(LEVELS):
            padded = F.pad(level, (0, 1, 0, 1), mode="circular")
            stack.append(F.pad(padded, (0, size + 1 - padded.shape[-1], 0, 0)))
            level = F.avg_pool2d(level, 2)
        columns.append(torch.cat(stack, -2))
    heights = torch.tensor([0] + [(size >> level) + 1 for level in range(LEVELS - 1)])
    return Atlas(torch.cat(columns, -1), size, heights.cumsum(0))


def albedo(draw: Draw, batch: int, size: int) -> Tensor:
    """[B, 3, size, size] in [0, 1]: three colours of growth, cracks, and things strewn about."""
    fine = spectral(draw, size, draw.uniform(batch, low=0.6, high=1.9))
    blobs = spectral(draw, size, draw.uniform(batch, low=0.6, high=1.9))
    patches = spectral(draw, size, draw.uniform(batch, low=1.6, high=2.6))
    colours = draw.uniform(3, batch, 3, 1, 1, low=0.05, high=0.85)
    # Most of nature is near grey; the water makes the colours.
    colours = colours.mean(2, keepdim=True).lerp(colours, draw.uniform(batch, 1, 1, 1))
    contrast = draw.log_uniform(batch, 1, 1, low=0.1, high=0.5)
    threshold = draw.uniform(batch, 1, 1, high=2.0)
    sharpness = draw.uniform(batch, 1, 1, low=2.0, high=10.0)
    speckles = torch.sigmoid((blobs - threshold) * sharpness)[:, None]
    growth = 0.6 * torch.sigmoid((patches - 0.3) * sharpness)[:, None]
    ground = (1.0 + contrast * fine)[:, None]
    result = (colours[0] * ground).lerp(
        colours[1] * (1.0 + 0.3 * contrast * patches)[:, None], speckles
    )
    result = result.lerp(colours[2] * ground, growth)
    cracks = torch.exp(
        -draw.uniform(batch, 1, 1, low=6.0, high=25.0) * blobs.roll(size // 3, 1).abs()
    )
    result = result * (1.0 - draw.uniform(batch, 1, 1, high=0.7) * cracks)[:, None]
    strewn = stamp(
        draw,
        size,
        draw.log_uniform(batch, low=3e-5, high=3e-3),
        draw.log_uniform(batch, low=1.5, high=12.0),
        draw.uniform(batch, low=-1.0, high=0.9).clamp_min(0.0),
    )[:, None]
    thing = draw.uniform(batch, 3, 1, 1, low=0.05, high=0.95)
    return result.lerp(thing * ground, strewn * draw.uniform(batch, 1, 1, 1)).clamp(0.01, 1.0)
