"""What the compact prior's network is made of."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CONTRAST_WINDOW = 8
"""px of the blocks whose mean and contrast are smoothed and taken away."""
CONTRAST_FLOOR = 1e-4
"""Variance, picture in [0, 1], below which contrast is noise."""


def locally_normalised(
    image: Tensor,  # [B, 3, H, W] in [0, 1]
) -> Tensor:
    """[B, 3, H, W] of mean about 0 and contrast about 1 around every pixel."""
    centred = image - _smooth(image)
    return centred * torch.rsqrt(_smooth(centred * centred) + CONTRAST_FLOOR)


def _smooth(
    image: Tensor,  # [B, C, H, W]
) -> Tensor:
    blocks = F.avg_pool2d(image, CONTRAST_WINDOW)
    blocks = F.avg_pool2d(blocks, 3, 1, 1, count_include_pad=False)
    return F.interpolate(
        blocks, scale_factor=float(CONTRAST_WINDOW), mode="bilinear", align_corners=False
    )


def convolved(channels: int, out: int, size: int, stride: int, dilation: int = 1) -> nn.Sequential:
    """Convolution, normalisation over the batch, ReLU."""
    padding = size // 2 * dilation
    return nn.Sequential(
        nn.Conv2d(channels, out, size, stride, padding, dilation, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = convolved(channels, channels, 3, 1, dilation)
        self.second = convolved(channels, channels, 3, 1)[:2]

    def forward(
        self,
        x: Tensor,  # [B, C, H, W]
    ) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


class Up(nn.Module):
    """Twice the resolution, summed with what the way down had there."""

    def __init__(self, below: int, beside: int, out: int) -> None:
        super().__init__()
        self.below, self.beside = nn.Conv2d(below, out, 1), nn.Conv2d(beside, out, 1)
        self.refined = Residual(out)

    def forward(
        self,
        below: Tensor,  # [B, C, H/2, W/2]
        beside: Tensor,  # [B, C', H, W]
    ) -> Tensor:
        raised = F.interpolate(
            self.below(below), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        refined: Tensor = self.refined(F.relu(raised + self.beside(beside)))
        return refined
