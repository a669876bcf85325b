"""The paper's loss terms except L1 and SSIM, which are in the renderer (Eq. 18, 21 and 23)."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.render.contract import CPU

RADIAL_VARIANCE = 5.0
"""sigma^2 of K_rad in units of the half picture: corner weight 0.82 (ARTDECO; docs/paper.md)."""
MIN_RANGE = 1e-2
"""Map units; guards 1 / range."""


def radial_weight(height: int, width: int, device: torch.device = CPU) -> Tensor:
    """K_rad [H, W] = exp(-r^2 / (2 sigma^2)), r in [-1, 1]^2 picture coordinates."""
    y = torch.linspace(-1.0, 1.0, height, device=device)[:, None]
    x = torch.linspace(-1.0, 1.0, width, device=device)[None, :]
    return torch.exp(-(x * x + y * y) / (2.0 * RADIAL_VARIANCE)).contiguous()


def outlier_mask(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    K_rad: Tensor,  # [H, W]
    tau_e: float,
) -> Tensor:
    """M [H, W] bool: False where any channel's weighted residual exceeds ``tau_e``."""
    worst = (rendered.detach() - target).abs().amax(dim=-1)
    return K_rad * worst <= tau_e


def depth_loss(
    z: Tensor,  # [H, W] rendered range
    alpha: Tensor,  # [H, W]
    inverse_range: Tensor,  # [H, W] 1 / range of the prior; 0 where unknown
    weight: Tensor,  # [H, W] K_rad x mask x the prior's confidence
) -> Tensor:
    """L_depth: weighted L1 between inverse ranges, where the prior knows and the map is solid."""
    known = weight * (inverse_range > 0.0) * (alpha.detach() > 0.5)
    return (known * (1.0 / z.clamp_min(MIN_RANGE) - inverse_range).abs()).mean()


def scale_loss(
    log_scales: Tensor,  # [N, 3]
) -> Tensor:
    """L_scale: mean volume, which keeps Gaussians from growing over what they do not explain."""
    return torch.exp(log_scales.sum(dim=-1)).mean()
