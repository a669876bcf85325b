"""White balance and amplification of a scene without its water.

The clean radiance J is the scene as it would look through no water at all. Nobody has seen it so:
its white balance is the camera's, set for a scene in water, times what the fit makes of the water
between, and an error in the attenuation becomes a cast of colour. So what is shown is J under one
gain per channel, by which what was seen nearest has on the mean the colour that the camera saw,
backscatter included: what is nearest keeps its colours, and what is further away gets the same.
Where another white balance is chosen, another gain comes on top (illuminant.py).

What returns little light is amplified, its noise and the water's own uncertainty with it. A picture
is therefore the mean of what J may be (a linear minimum mean square error estimate): where light is
lost in one channel that channel follows the others towards a grey scene; where it is lost in all,
it fades to the scene's mean.

With T and B the transmission and the backscatter, A = diag(T), noise covariance N (diagonal) and
J ~ (m, S), a pixel I = A J + B + noise gives

    J-hat = G (I - B) + (1 - G A) m,   G = S A (A S A + N)^-1

G A is the share of J-hat that follows the pixel, 1 - G A the share that is the prior's (Rodgers,
Inverse Methods for Atmospheric Sounding, 2000, calls G A the averaging kernel). Its eigenvalues lie
in [0, 1), so the confidence of a pixel is tr(G A) / 3: 1 where all three channels were seen, 1/3
where one was and the others follow it, 0 where the prior stands alone.

How far a channel may be amplified: G_cc is the regression of J_c on its own channel's light given
the others' light, T_c v / (T_c^2 v + N_c), with v <= S_cc the variance of J_c that the others
leave. As T_c^2 v + N_c is at least T_c^2 v and at least 2 T_c sqrt(v N_c),

    G_cc <= min(1 / T_c, sqrt(S_cc / N_c) / 2)

whatever the pixel is: less light is amplified more only until it drowns in the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.config.white_balance import CAMERA
from aquaflow.render.transfers import water_in
from aquaflow.water.medium import MAX_RESTORED, WaterParameters

PICTURE_NOISE = 0.01
"""Deviation of a pixel's value: two grey levels and a half, as in compressed video."""
VEIL_ERROR = 0.1
"""Relative error of the backscatter: what its closed form misses on Curasao, IUI3 and the reef."""
CONTRAST = 0.6
"""Deviation of a scene's colours over their mean: 0.4 to 0.8 on the shared clips."""
GREY = 0.9
"""Correlation of a scene's channels: 0.85 to 0.97 on the same clips' nearest quarter."""


LEAST_LIGHT = 1e-6
"""Share of full scale: guards the division where no light comes back."""

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Recovered:
    """A picture without its water, and how far it can be relied on."""

    picture: Tensor
    """[H, W, 3]"""
    confidence: Tensor
    """[H, W] in [0, 1], the share of the colour that is the picture's and not the prior's."""
    amplification: Tensor | None = None
    """[H, W, 3] restored per observed light of the same channel; None without a posterior."""
    allowed: Tensor | None = None
    """[H, W, 3] the most that the posterior lets it be at that range."""


@dataclass(frozen=True)
class ChosenWhite:
    """A white balance that was asked for, on top of the camera's."""

    name: str = CAMERA
    """``camera``, ``neutral``, ``daylight``, ``daylight:TYPE``, or the ``FRAME:X,Y`` that is
    grey."""
    gain: Rgb = (1.0, 1.0, 1.0)
    """RGB; the scene's mean luminance stays."""
    sigma: Rgb | None = None
    """Relative deviation of ``gain``; None: the camera's, which is what it is."""


@dataclass(frozen=True)
class WhiteBalance:
    """What restored pictures are shown in."""

    near_range: float
    """Map units; the range whose colours are kept."""
    mean: tuple[float, float, float]
    """Mean of J over what was seen, RGB."""
    gain: tuple[float, float, float]
    """Of J, RGB: by it what was seen nearest keeps the mean colour that the camera saw."""
    attenuation_sigma: float
    """Relative deviation of the attenuation, mean of RGB."""
    chosen: ChosenWhite = ChosenWhite()
    """What comes on top of ``gain``."""

    @property
    def white(self) -> Rgb:
        """Gain of J that is shown, RGB."""
        red, green, blue = (a * b for a, b in zip(self.gain, self.chosen.gain, strict=True))
        return red, green, blue

    def recover(
        self,
        image: Tensor,  # [H, W, 3] evenly lit
        z: Tensor,  # [H, W] range, map units
        water: WaterParameters,
        uneven: Tensor | None = None,  # [H, W] gain of the backscatter
    ) -> Recovered:
        """The balanced picture without water; the module's text derives it."""
        T, veil = water.transmission(z), water.backscatter(z)
        veil = veil if uneven is None else veil * uneven[..., None]
        mean, white = (water_in(each, z.device) for each in (self.mean, self.white))
        depth = water.beta_a * (z[..., None] - self.near_range).clamp_min(0.0)
        noise = PICTURE_NOISE**2 + (VEIL_ERROR * veil).square()
        noise = noise + (self.attenuation_sigma * depth * mean * T).square()
        deviation = CONTRAST * mean
        # A S A + N = diag(alone) + GREY light light^T, solved by Sherman and Morrison's formula.
        light = T * deviation
        alone = (1.0 - GREY) * light.square() + noise
        share = light / alone
        whole = 1.0 + GREY * (light * share).sum(dim=-1, keepdim=True)
        left = image - veil - T * mean
        fit = left / alone - GREY * share * (share * left).sum(dim=-1, keepdim=True) / whole
        common = (light * fit).sum(dim=-1, keepdim=True)
        J = mean + deviation * (GREY * common + (1.0 - GREY) * light * fit)
        single = 1.0 / alone - GREY * share.square() / whole
        own = deviation * (GREY * share / whole + (1.0 - GREY) * light * single)  # of G, diagonal
        return Recovered(
            (J * white).clamp(0.0, MAX_RESTORED),
            (own * T).mean(dim=-1).clamp(0.0, 1.0),
            own * white,
            torch.minimum(1.0 / T, deviation / (2.0 * noise.sqrt())) * white,
        )

    def noise_of_light(
        self,
        water: WaterParameters,
        z: float,  # range, map units
        pixels: int = 1,  # that are averaged over
    ) -> Tensor:
        """[3] relative deviation of the light of a channel that comes back from the scene's mean
        colour at the range."""
        at = water_in([z], water.beta_a.device)
        light = water.transmission(at)[0] * water_in(self.mean, at.device)
        veil = VEIL_ERROR * water.backscatter(at)[0]
        return (PICTURE_NOISE**2 / pixels + veil.square()).sqrt() / light.clamp_min(LEAST_LIGHT)
