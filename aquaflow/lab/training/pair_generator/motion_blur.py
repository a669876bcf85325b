"""What a long exposure does: every point is drawn out along the camera's motion."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw

LENGTH_PX = (1.0, 6.0)
"""Way of a point during the exposure."""
TAPS = 9
"""Width of the kernel: holds the longest way in any direction."""
SAMPLES = 16
"""Instants of the exposure that are summed."""


def with_motion_blur(
    draw: Draw,
    radiance: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W], each picture along a direction of its own; points stay at the way's middle."""
    batch, channels = radiance.shape[:2]
    length = draw.uniform(batch, 1, low=LENGTH_PX[0], high=LENGTH_PX[1])
    angle = draw.uniform(batch, 1, high=2.0 * math.pi)
    instant = torch.linspace(-0.5, 0.5, SAMPLES, device=draw.device)[None]
    x, y = length * instant * angle.cos(), length * instant * angle.sin()
    axis = torch.arange(TAPS, device=draw.device) - TAPS // 2
    near_x = (1.0 - (axis[None, None] - x[..., None]).abs()).clamp_min(0.0)
    near_y = (1.0 - (axis[None, None] - y[..., None]).abs()).clamp_min(0.0)
    kernel = near_y.mT @ near_x / SAMPLES
    kernels = kernel[:, None].repeat_interleave(channels, 0)
    half = TAPS // 2
    padded = F.pad(radiance, (half, half, half, half), mode="reflect")
    flat = padded.view(1, batch * channels, *padded.shape[-2:])
    return F.conv2d(flat, kernels, groups=batch * channels).view_as(radiance)
