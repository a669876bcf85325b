"""Underwater image formation (paper, Eq. 12, 15 and 16).

    I = J exp(-beta_a z) + B(z),   B(z) = B_inf (1 - exp(-b z)) + B_res exp(-d z)

with z the range along the ray. Rendering composes it in :mod:`aquaflow.render.water`; here it is
inverted, to see a picture without its water.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.render.water import MAX_OPTICAL_DEPTH

MIN_TRANSMISSION = 0.05
"""Where less light arrives, the scene's colour cannot be recovered (docs/paper.md#deviations)."""
MAX_RESTORED = 2.0
"""Radiance that restoration may return: twice the brightest white that the camera can store."""


@dataclass(frozen=True)
class WaterParameters:
    """The medium's parameters for one picture, each [3] RGB; rates per map unit.

    For points that were seen from several views, beta_a is [N, 3].
    """

    beta_a: Tensor
    B_inf: Tensor
    b: Tensor
    B_res: Tensor
    d: Tensor

    def backscatter(
        self,
        z: Tensor,  # [...] range
    ) -> Tensor:
        """B(z) [..., 3]."""
        near = torch.exp(-_optical_depth(self.d, z))
        far = -torch.expm1(-_optical_depth(self.b, z))
        return self.B_inf * far + self.B_res * near

    def transmission(
        self,
        z: Tensor,  # [...] range
    ) -> Tensor:
        """exp(-beta_a z) [..., 3]."""
        return torch.exp(-_optical_depth(self.beta_a, z))

    def stack(self) -> Tensor:
        """[5, 3] in the order that the fused kernel takes."""
        return torch.stack([self.beta_a, self.B_inf, self.b, self.B_res, self.d])

    def restore(
        self,
        image: Tensor,  # [H, W, 3]
        z: Tensor,  # [H, W] range
        uneven: Tensor | None = None,  # [H, W] gain of the backscatter
    ) -> tuple[Tensor, Tensor]:
        """J-hat [H, W, 3] of the paper, and where it can be believed [H, W]."""
        transmission, veil = self.transmission(z), self.backscatter(z)
        if uneven is not None:
            veil = veil * uneven[..., None]
        recoverable = (transmission > MIN_TRANSMISSION).all(dim=-1)
        restored = (image - veil) / transmission.clamp_min(MIN_TRANSMISSION)
        return restored.clamp(0.0, MAX_RESTORED), recoverable


def _optical_depth(
    rate: Tensor,  # [3], or [..., 3] where z is [...]; 1 / map unit
    z: Tensor,  # [...] map units
) -> Tensor:
    return (rate * z[..., None]).clamp(0.0, MAX_OPTICAL_DEPTH)
