"""Periodic random fields, and looking them up anywhere."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F


def spectral(
    draw: Draw,
    size: int,
    slope: Tensor,  # [B] of the power spectrum; 2 is a rough rock, 4 a smooth dune
) -> Tensor:
    """[B, size, size] periodic fractal noise of mean 0 and deviation 1."""
    frequency = torch.fft.fftfreq(size, device=draw.device) * size
    radius = torch.sqrt(frequency[:, None] ** 2 + frequency[None] ** 2)
    radius[0, 0] = 1.0
    white = torch.fft.fft2(draw.normal(len(slope), size, size))
    white = white * radius ** (-slope[:, None, None] / 2.0)
    white[:, 0, 0] = 0.0
    field: Tensor = torch.fft.ifft2(white).real
    return field / field.std(dim=(-1, -2), keepdim=True).clamp_min(1e-6)


def stamp(
    draw: Draw,
    size: int,
    share: Tensor,  # [B] of the texels that are the middle of a stamp
    radius: Tensor,  # [B] texels
    ring: Tensor,  # [B] 0 for discs, up to 1 for thin rings
) -> Tensor:
    """[B, size, size] in [0, 1]: discs or rings strewn about; pebbles, polyps, shells."""
    middles = (draw.uniform(len(share), size, size) < share[:, None, None]).float()
    middles = middles * draw.uniform(len(share), size, size, low=0.3)
    axis = (torch.arange(size, device=draw.device) + size // 2) % size - size // 2
    distance = torch.sqrt((axis[:, None] ** 2 + axis[None] ** 2).float())
    radius = radius[:, None, None]
    disc = (radius + 0.5 - distance).clamp(0.0, 1.0)
    hole = (radius * ring[:, None, None] + 0.5 - distance).clamp(0.0, 1.0)
    kernel = torch.fft.fft2(disc - torch.where(ring[:, None, None] > 0, hole, 0.0))
    strewn: Tensor = torch.fft.ifft2(torch.fft.fft2(middles) * kernel).real
    return strewn.clamp(0.0, 1.0)


def wrap(
    field: Tensor,  # [B, C, n, n] periodic
) -> Tensor:
    """[B, C, n + 1, n + 1] ready for ``periodic``: the first row and column once more."""
    return F.pad(field, (0, 1, 0, 1), mode="circular")


def periodic(
    field: Tensor,  # [B, C, n + 1, n + 1] from ``wrap``
    places: Tensor,  # [B, N, 2] in periods
) -> Tensor:
    """[B, C, N] bilinear values."""
    grid = (places - places.floor()) * 2.0 - 1.0
    values = F.grid_sample(
        field, grid[:, :, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return values[..., 0]


# --------------------------------------------------------------------------------------------------
# Random numbers by range, all from one generator, on that generator's device.


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
