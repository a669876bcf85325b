"""What the loss needs beside the terms of a view that the renderer has: K_rad, and Eq. 23."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.render.contract import CPU

RADIAL_VARIANCE = 5.0
"""sigma^2 of K_rad in units of the half picture: corner weight 0.82 (ARTDECO; docs/paper.md)."""


def radial_weight(height: int, width: int, device: torch.device = CPU) -> Tensor:
    """K_rad [H, W] = exp(-r^2 / (2 sigma^2)), r in [-1, 1]^2 picture coordinates."""
    y = torch.linspace(-1.0, 1.0, height, device=device)[:, None]
    x = torch.linspace(-1.0, 1.0, width, device=device)[None, :]
    return torch.exp(-(x * x + y * y) / (2.0 * RADIAL_VARIANCE)).contiguous()


def scale_loss(
    log_scales: Tensor,  # [N, 3]
) -> Tensor:
    """L_scale: mean volume, which keeps Gaussians from growing over what they do not explain."""
    return torch.exp(log_scales.sum(dim=-1)).mean()
