"""Textures filtered to the size of a ray's footprint: all mip levels in one atlas."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch.nn import functional

from aquaflow.lab.synthetic.noise import FloatMap


class MipAtlas:
    """A texture and its halvings, sampled trilinearly (bilinear in two levels, then between)."""

    def __init__(
        self,
        texture: FloatMap,  # [H, W, C]; H and W divide by 2 ** (levels - 1)
        levels: int,
    ) -> None:
        height, width, channels = texture.shape
        self.levels = levels
        self.width, self.height = width, height
        atlas = torch.zeros(channels, height, width + width // 2)
        offsets: list[tuple[int, int]] = []
        level, x, y = texture, 0, 0
        for k in range(levels):
            h, w = height >> k, width >> k
            if k > 0:
                halved = cv2.resize(level, (w, h), interpolation=cv2.INTER_AREA)
                level = np.asarray(halved, np.float32).reshape(h, w, channels)
            atlas[:, y : y + h, x : x + w] = torch.from_numpy(level).permute(2, 0, 1)
            offsets.append((x, y))
            # Level 0 on the left, the others stacked to its right.
            x, y = width, (0 if k == 0 else y + h)
        self._atlas = atlas[None]
        self._offset_x = torch.tensor([float(o[0]) for o in offsets])
        self._offset_y = torch.tensor([float(o[1]) for o in offsets])

    def sample(
        self,
        u: torch.Tensor,  # [N] texels of level 0, 0 at the left edge
        v: torch.Tensor,  # [N] texels of level 0, 0 at the top edge
        footprint: torch.Tensor,  # [N] texels of level 0
    ) -> torch.Tensor:
        """Values [C, N], clamped to the texture's edge."""
        lod = footprint.clamp_min(1.0).log2().clamp_max(self.levels - 1.001)
        lower = lod.floor()
        share = lod - lower
        fine = self._level(u, v, lower)
        return fine + (self._level(u, v, lower + 1.0) - fine) * share

    def mirror(
        self,
        u: torch.Tensor,  # [N] texels
        v: torch.Tensor,  # [N] texels
        footprint: torch.Tensor,  # [N] texels
    ) -> torch.Tensor:
        """As :meth:`sample`, the texture repeated as in a mirror, so without seams."""
        return self.sample(_fold(u, self.width), _fold(v, self.height), footprint)

    def _level(
        self,
        u: torch.Tensor,  # [N] texels
        v: torch.Tensor,  # [N] texels
        level: torch.Tensor,  # [N] whole numbers
    ) -> torch.Tensor:
        scale = torch.exp2(-level)
        index = level.long()
        wide, tall = self.width * scale, self.height * scale
        # Half a texel inside the level: no bleeding from its neighbours in the atlas.
        x = torch.minimum((u * scale).clamp_min(0.5), wide - 0.5) + self._offset_x[index]
        y = torch.minimum((v * scale).clamp_min(0.5), tall - 0.5) + self._offset_y[index]
        rows, columns = self._atlas.shape[2:]
        grid = torch.stack([x * (2.0 / columns) - 1.0, y * (2.0 / rows) - 1.0], dim=-1)
        out = functional.grid_sample(
            self._atlas, grid[None, None], padding_mode="border", align_corners=False
        )
        return out[0, :, 0]


def _fold(
    u: torch.Tensor,  # [N] texels
    size: int,
) -> torch.Tensor:
    return (torch.remainder(u, 2.0 * size) - size).abs()
