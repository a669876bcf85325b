"""Dense marine snow: particles lit in front of the lens, small and sharp or near and blurred."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw

SHARE = (0.001, 0.012)
"""Of the pixels that show a particle."""
LIGHT = (0.2, 1.5)
"""Of a particle, relative to the picture's mean."""
LAYERS = (1, 3, 7)
"""px across a particle of each layer; the larger ones are nearer, fewer and out of focus."""


def with_snow(
    draw: Draw,
    radiance: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W] with particles of the picture's own; another picture has others."""
    batch, _, height, width = radiance.shape
    share = draw.log_uniform(batch, 1, 1, 1, low=SHARE[0], high=SHARE[1])
    light = draw.uniform(batch, 1, 1, 1, low=LIGHT[0], high=LIGHT[1])
    snow = torch.zeros(batch, 1, height, width, device=draw.device)
    for across in LAYERS:
        there = draw.uniform(batch, 1, height, width) < share / across
        bright = there * draw.uniform(batch, 1, height, width)
        for _ in range(2 if across > 1 else 0):
            # Twice a box makes a round spot; its middle stays as bright as a small particle.
            bright = F.avg_pool2d(bright, across, 1, across // 2) * across**0.9
        snow = snow + bright
    mean = radiance.mean(dim=(1, 2, 3), keepdim=True)
    return radiance + mean * light * snow.clamp_max(2.0)
