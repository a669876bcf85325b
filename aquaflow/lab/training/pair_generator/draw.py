"""Random numbers by range, all from one generator, on that generator's device."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Draw:
    """Draws of any shape; the same seed gives the same scenes."""

    def __init__(self, seed: int, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.generator = torch.Generator(self.device).manual_seed(seed)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """[*shape], even between ``low`` and ``high``."""
        unit = torch.rand(shape, generator=self.generator, device=self.device)
        return low + (high - low) * unit

    def log_uniform(self, *shape: int, low: float, high: float) -> Tensor:
        """[*shape], their logarithms even between those of ``low`` and ``high``."""
        return self.uniform(*shape, low=math.log(low), high=math.log(high)).exp()

    def normal(self, *shape: int, sigma: float = 1.0) -> Tensor:
        """[*shape], normal about zero."""
        return sigma * torch.randn(shape, generator=self.generator, device=self.device)

    def chance(self, share: float, *shape: int) -> Tensor:
        """bool, true for ``share`` of them."""
        return self.uniform(*shape) < share

    def whole(self, *shape: int, below: int) -> Tensor:
        """int64 in [0, below)."""
        return torch.randint(below, shape, generator=self.generator, device=self.device)
