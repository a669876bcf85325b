"""White balance and amplification of a scene without its water.

The clean radiance J is the scene as it would look through no water at all. Nobody has seen it so:
its white balance is the camera's, set for a scene in water, times what the fit makes of the water
between, and an error in the attenuation becomes a cast of colour. So what is shown is J as it would
look through the water of the nearest range that the dive has: what is nearest keeps the colours
that the camera gave it, and what is further away gets the same.

What returns little light is amplified, its noise and the water's own uncertainty with it. A picture
is therefore the mean of what J may be (a linear minimum mean square error estimate): where light is
lost in one channel that channel follows the others towards a grey scene; where it is lost in all,
it fades to the scene's mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.mapping.water.image_formation import MAX_RESTORED, Water
from aquaflow.mapping.water.observations import Observations

Array = npt.NDArray[np.float64]

NEAR_QUANTILE = 0.05
"""Share of the observations that are nearer than the range whose colours are kept."""
PICTURE_NOISE = 0.01
"""Deviation of a pixel's value: two grey levels and a half, as in compressed video."""
VEIL_ERROR = 0.1
"""Relative error of the backscatter: what its closed form misses on Curasao, IUI3 and the reef."""
CONTRAST = 0.6
"""Deviation of a scene's colours over their mean: 0.4 to 0.8 on the shared clips."""
GREY = 0.9
"""Correlation of a scene's channels: 0.85 to 0.97 on the same clips' nearest quarter."""


@dataclass(frozen=True)
class WhiteBalance:
    """What restored pictures are shown in."""

    near_range: float
    """Map units; the range whose colours are kept."""
    mean: tuple[float, float, float]
    """Mean of J over what was seen, RGB."""
    attenuation_sigma: float
    """Relative deviation of the attenuation, mean of RGB."""

    def gain(self, water: Water) -> Tensor:
        """[3] of J: what it looks like through the water of the near range."""
        return water.transmission(torch.tensor(self.near_range))

    def recover(
        self,
        image: Tensor,  # [H, W, 3] evenly lit
        z: Tensor,  # [H, W] range, map units
        water: Water,
        uneven: Tensor | None = None,  # [H, W] gain of the backscatter
    ) -> Tensor:
        """[H, W, 3] the balanced picture without water."""
        T, veil = water.transmission(z), water.backscatter(z)
        veil = veil if uneven is None else veil * uneven[..., None]
        mean = torch.tensor(self.mean)
        depth = water.beta_a * (z[..., None] - self.near_range).clamp_min(0.0)
        noise = PICTURE_NOISE**2 + (VEIL_ERROR * veil).square()
        noise = noise + (self.attenuation_sigma * depth * mean * T).square()
        deviation = CONTRAST * mean
        spread = GREY * deviation[:, None] * deviation + (1.0 - GREY) * torch.diag(deviation**2)
        # J = m + S A (A S A + N)^-1 (I - B - A m), A and N diagonal.
        seen = T[..., :, None] * spread * T[..., None, :] + torch.diag_embed(noise)
        off = (image - veil - T * mean)[..., None]
        J: Tensor = mean + (spread @ (T[..., None] * torch.linalg.solve(seen, off)))[..., 0]
        return (J * self.gain(water)).clamp(0.0, MAX_RESTORED)


def white_balance(
    seen: Observations,
    J: Array,  # [3, P] of the points
    relative_sigma: list[float],  # [3] of the attenuation
) -> WhiteBalance:
    """Of a dive whose water was fitted to these observations."""
    red, green, blue = np.maximum(J.mean(axis=1), 1e-3).tolist()
    near = float(np.quantile(seen.z, NEAR_QUANTILE))
    return WhiteBalance(near, (red, green, blue), float(np.mean(relative_sigma)))
