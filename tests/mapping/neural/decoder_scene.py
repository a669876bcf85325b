"""A few Gaussians in voxel groups, and a decoder with random weights."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from aquaflow.config import DecoderConfig
from aquaflow.mapping.neural.decoder import Decoder, Tokens, observation, visible_tokens
from aquaflow.mapping.neural.voxel_groups import VoxelGroups

ROWS = 23
CENTRE = torch.tensor([0.1, -0.2, -1.0], dtype=torch.float64)


class Scene:
    """A few Gaussians in groups of one to seven, and a decoder that has learned something."""

    def __init__(self, seed: int = 0, trained: bool = True, **settings: Any) -> None:
        self.random = torch.Generator().manual_seed(seed)
        options: dict[str, Any] = {"width": 8, "local_width": 5, "global_width": 3, **settings}
        self.config = DecoderConfig(**options)
        cell = torch.tensor([0] * 9 + [1] * 5 + [2] * 1 + [3] * 8, dtype=torch.float64)
        inside = self.config.voxels.size * (0.1 + 0.8 * self.uniform(ROWS, 3))
        self.means = inside + self.config.voxels.size * cell[:, None]
        small = self.config.voxels.model_copy(update={"capacity": 7})
        self.groups = VoxelGroups(small, self.config.global_width)
        self.groups.insert(self.means)
        self.decoder = Decoder(self.config, self.random).double()
        if trained:
            for head in (self.decoder.geometry, self.decoder.colour):
                for weight in head.parameters():
                    torch.nn.init.normal_(weight, std=0.5, generator=self.random)
        self.local = self.normal(ROWS, self.config.local_width)
        self.shared = self.normal(len(self.groups), self.config.global_width)
        self.parameters = {
            "means": self.means,
            "quats": torch.nn.functional.normalize(self.normal(ROWS, 4)),
            "log_scales": self.normal(ROWS, 3),
            "opacity_logits": self.normal(ROWS, 1),
            "raw_colours": self.normal(ROWS, 3),
        }

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.random, dtype=torch.float64)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.random, dtype=torch.float64)

    def residuals(self, tokens: Tokens | None = None, centre: Tensor = CENTRE) -> Tensor:
        """[N, 9]"""
        everyone = torch.ones(ROWS, dtype=torch.bool)
        tokens = visible_tokens(self.groups, everyone) if tokens is None else tokens
        early = observation(self.means[tokens.rows], centre)
        early = early if self.decoder.observes_first else None
        trunk = self.decoder.trunk(tokens, self.local, self.shared, early)
        places = tokens.places(everyone)
        rows = tokens.rows[places]
        o = observation(self.means[rows], centre)
        found = self.decoder.residuals(trunk, places, o)
        return found.new_zeros(ROWS, 9).index_copy(0, rows, found)
