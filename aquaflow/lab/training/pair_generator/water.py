"""Water between scene and camera, drawn anew for each use of a pair (paper's image formation)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from aquaflow.lab.synthetic.water import WATER_TYPES
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pairs import ViewBatch

MEDIAN_RANGE_M = (0.6, 6.0)
"""How far away the scene is taken to be: scenes are as large as one likes."""
MOST_ATTENUATION = 1.2
"""Optical depth of the clearest channel at the median range: more, and nothing is seen."""
TURBID = (1.5, 3.5)
"""Factor of turbid water's attenuation: two to four optical depths at the median range."""
FAR_M = 1e3
"""Range of the open water."""


@dataclass(frozen=True)
class WaterBatch:
    """I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z), z in the scene's metres."""

    beta_a: Tensor
    """[B, 3] 1/m"""
    b: Tensor
    """[B, 3] 1/m"""
    B_inf: Tensor
    """[B, 3]"""
    B_res: Tensor
    """[B, 3]"""
    d: Tensor
    """[B, 3] 1/m"""

    def denser(
        self,
        factor: Tensor,  # [B]
    ) -> WaterBatch:
        """The same water with ``factor`` times as much in it."""
        factor = factor[:, None]
        return replace(self, beta_a=factor * self.beta_a, b=factor * self.b, d=factor * self.d)

    def through(self, view: ViewBatch) -> Tensor:
        """[B, 3, H, W] the radiance that reaches the camera."""
        height, width = view.depth.shape[-2:]
        z = (view.depth * view.rays(height, width).norm(dim=-1))[:, None]
        z = torch.where(view.depth[:, None] > 0, z, FAR_M)
        beta_a, b, B_inf, B_res, d = (
            x[..., None, None] for x in (self.beta_a, self.b, self.B_inf, self.B_res, self.d)
        )
        direct = view.image * torch.exp(-beta_a * z)
        return direct + B_inf * (1.0 - torch.exp(-b * z)) + B_res * torch.exp(-d * z)


def turbidity(draw: Draw, share: float, batch: int) -> Tensor:
    """[B] factors of ``WaterBatch.denser``: 1 but for ``share`` of them."""
    if share == 0.0:
        return torch.ones(batch, device=draw.device)
    factor = draw.uniform(batch, low=TURBID[0], high=TURBID[1])
    return torch.where(draw.chance(share, batch), factor, 1.0)


def random_water(
    draw: Draw,
    median_range: Tensor,  # [B] of the scene, its metres
) -> WaterBatch:
    """Between two neighbours of the table of Jerlov's types, and off it by a fifth or so."""
    batch = len(median_range)
    types = list(WATER_TYPES.values())[1:]
    place = draw.uniform(batch, high=len(types) - 1.0)
    low = place.floor().long().clamp_max(len(types) - 2)
    share = (place - low)[:, None]

    def between(name: str, jitter: float) -> Tensor:
        table = torch.tensor([getattr(kind, name) for kind in types], device=draw.device)
        value = torch.lerp(table[low], table[low + 1], share)
        return value * draw.normal(batch, 3, sigma=jitter).exp()

    metres = draw.log_uniform(batch, low=MEDIAN_RANGE_M[0], high=MEDIAN_RANGE_M[1])
    beta_a = between("beta_a", 0.2)
    most = MOST_ATTENUATION / beta_a.amin(1)
    scale = (torch.minimum(metres, most) / median_range)[:, None]
    # Under lamps in the dark the open water is nearly black.
    dark = torch.where(draw.chance(0.2, batch, 1), draw.uniform(batch, 1, high=0.3), 1.0)
    return WaterBatch(
        beta_a * scale,
        between("b", 0.25) * scale,
        between("B_inf", 0.25) * dark,
        between("B_res", 0.5) * draw.uniform(batch, 1, high=2.0),
        between("d", 0.3) * scale,
    )
