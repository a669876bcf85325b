"""Pictures taken with too little light: dim, noisy, and in few levels of grey."""

from __future__ import annotations

from torch import Tensor

from aquaflow.lab.training.pair_generator.draw import Draw

LEVEL = (0.08, 0.5)
"""Of the brightness that automatic exposure aims at."""
NOISE = (0.003, 0.02)
"""Standard deviation of the noise, in full scale: against LEVEL a tenth of the signal."""
GREYS = 255.0
"""Levels of a camera's 8-bit output."""


def in_low_light(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W] in [0, 1]
) -> Tensor:
    """[B, 3, H, W] in [0, 1]"""
    batch = len(image)
    dim = image * draw.log_uniform(batch, 1, 1, 1, low=LEVEL[0], high=LEVEL[1])
    noise = draw.log_uniform(batch, 1, 1, 1, low=NOISE[0], high=NOISE[1])
    dim = dim + draw.normal(*image.shape) * noise * (0.3 + dim.clamp_min(0.0)).sqrt()
    return (dim.clamp(0.0, 1.0) * GREYS).round() / GREYS
