"""The learnable medium: attenuation, by the camera's orientation if wanted, and RGB backscatter.

Colour against medium is not identifiable without constraints (docs/paper.md#deviations): rates are
positive by softplus, colours lie in [0, 1] by sigmoid. The orientation multiplies the attenuation
by a factor whose logarithm has a mean of zero over the dive: the mean is the water fit's, which
knows it far better than photometric gradients do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from aquaflow.config import MediumConfig
from aquaflow.render.water import BANDS, MAX_OPTICAL_DEPTH, sinusoidal_encoding
from aquaflow.water.model import TERMS
from aquaflow.water.mounting import NEAREST_LIT, Lamp

MIN_RATE = 1e-4
"""1 / map unit; a rate of zero has no finite parameter."""
B_INF_RANGE = (0.01, 0.99)
"""What the water may start from: 0 and 1 have no finite logit."""
GLOW_RANGE = (1e-4, 0.99)
"""The same of the residual backscatter."""
MAX_LOG_FACTOR = 0.7
"""Log of the attenuation in one orientation over its mean; judgement: a factor of two."""


class LearnedMedium(nn.Module):
    """beta_a by MLP_a(gamma(vec R)); B_inf, b, B_res, d learnable RGB (paper, Eq. 13 to 15)."""

    def __init__(self, config: MediumConfig, generator: torch.Generator) -> None:
        super().__init__()
        inputs = 9 * (1 + 2 * BANDS)
        self.hidden = nn.Linear(inputs, config.width)
        self.output = nn.Linear(config.width, 3)
        bound = 1.0 / math.sqrt(inputs)
        with torch.no_grad():
            self.hidden.weight.uniform_(-bound, bound, generator=generator)
            self.hidden.bias.zero_()
            # Isotropic water to begin with; Adam's steps do not shrink with the gradient, so the
            # orientation gets its say as soon as the pictures show one.
            self.output.weight.zero_()
            self.output.bias.fill_(_inverse_softplus(config.initial_attenuation))
        self.B_inf_logit = nn.Parameter(torch.full((3,), _logit(config.initial_B_inf)))
        self.b_raw = nn.Parameter(torch.full((3,), _inverse_softplus(config.initial_attenuation)))
        self.B_res_logit = nn.Parameter(torch.full((3,), _logit(config.initial_B_res)))
        self.d_raw = nn.Parameter(
            torch.full((3,), _inverse_softplus(config.initial_residual_decay))
        )
        self.unevenness: Tensor
        self.register_buffer("unevenness", torch.zeros(TERMS))
        """Coefficients of the backscatter's log-gain over the picture."""
        self.mean_log_factor: Tensor
        self.register_buffer("mean_log_factor", torch.zeros(3))
        """What :meth:`centre` subtracts."""
        self.active, self.directional = config.enabled, config.directional

    def forward(
        self,
        R_wc: Tensor,  # [3, 3] or [V, 3, 3] camera to world
    ) -> WaterParameters:
        """The water as seen by a camera with this orientation; beta_a [V, 3] for V of them."""
        beta_a = F.softplus(self.output.bias).expand(*R_wc.shape[:-2], 3)
        if self.directional:
            log_factor = (self._log_factor(R_wc) - self.mean_log_factor) / MAX_LOG_FACTOR
            beta_a = beta_a * torch.exp(MAX_LOG_FACTOR * torch.tanh(log_factor))
        return WaterParameters(
            beta_a,
            torch.sigmoid(self.B_inf_logit),
            F.softplus(self.b_raw),
            torch.sigmoid(self.B_res_logit),
            F.softplus(self.d_raw),
        )

    def _log_factor(
        self,
        R_wc: Tensor,  # [..., 3, 3]
    ) -> Tensor:
        """[..., 3] before the mean is subtracted."""
        code = sinusoidal_encoding(R_wc.reshape(*R_wc.shape[:-2], 9))
        return F.linear(torch.tanh(self.hidden(code)), self.output.weight)

    @torch.no_grad()
    def centre(
        self,
        R_wc: Tensor,  # [V, 3, 3] of the dive's views
    ) -> None:
        """Let the log-factor have a mean of zero over these orientations."""
        if self.directional and len(R_wc):
            self.mean_log_factor.copy_(self._log_factor(R_wc).mean(dim=0))

    def learned_at(self, config: MediumConfig) -> list[dict[str, Any]]:
        """Adam's parameter groups, each with its rate."""
        names = ("B_inf_logit", "b_raw", "B_res_logit", "d_raw")
        return [
            {"params": [getattr(self, name) for name in names], "lr": config.rate},
            {
                "params": [self.hidden.weight, self.hidden.bias, self.output.weight],
                "lr": config.directional_rate,
            },
            {"params": [self.output.bias], "lr": config.rate},
        ]

    @torch.no_grad()
    def use_unit_and_light(
        self,
        scale: float,
        gain: Tensor,  # [3]
    ) -> None:
        """Let it be the same water where a length of one is ``scale``, and backscatter is ``gain``
        times as bright."""
        for raw in (self.output.bias, self.b_raw, self.d_raw):
            raw.copy_(inverse_softplus(F.softplus(raw) / scale))
        for logit, bounds in ((self.B_inf_logit, B_INF_RANGE), (self.B_res_logit, GLOW_RANGE)):
            logit.copy_(torch.logit((torch.sigmoid(logit) * gain).clamp(*bounds)))

    @torch.no_grad()
    def set_water(
        self,
        beta_a: Tensor,  # [3]
        B_inf: Tensor,  # [3]
        b: Tensor,  # [3]
        unevenness: Tensor | None = None,  # [5]
        glow: Tensor | None = None,  # [3] backscatter of a lamp, as from any range
    ) -> None:
        """Start from an estimate; the orientation's say stays as it is, and so does the residual
        term unless there is a ``glow``."""
        self.output.bias.copy_(inverse_softplus(beta_a))
        self.B_inf_logit.copy_(torch.logit(B_inf.clamp(*B_INF_RANGE)))
        self.b_raw.copy_(inverse_softplus(b))
        if glow is not None:
            self.B_res_logit.copy_(torch.logit(glow.clamp(*GLOW_RANGE)))
            self.d_raw.copy_(inverse_softplus(torch.zeros_like(glow)))
        self.unevenness.zero_() if unevenness is None else self.unevenness.copy_(unevenness)


def inverse_softplus(
    y: Tensor,  # [...]
) -> Tensor:
    """x with softplus(x) = y, for y > 0; guarded at both ends."""
    y = y.clamp_min(MIN_RATE)
    return y + torch.log(-torch.expm1(-y))


def _inverse_softplus(y: float) -> float:
    return float(inverse_softplus(torch.tensor(y)))


def _logit(p: float) -> float:
    return math.log(p / (1.0 - p))


# --------------------------------------------------------------------------------------------------
# Underwater image formation (paper, Eq. 12, 15 and 16).
#
#     I = J exp(-beta_a z) + B(z),   B(z) = B_inf (1 - exp(-b z)) + B_res exp(-d z)
#
# with z the range along the ray. Rendering composes it in :mod:`aquaflow.render.water`; here it is
# inverted, to see a picture without its water.

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
    lamp: Lamp | None = None

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
        """Share of J [..., 3] that is seen: exp(-beta_a z), times the light of a lamp."""
        T = torch.exp(-_optical_depth(self.beta_a, z))
        return T if self.lamp is None else T * self.light(self.lamp, z)

    def light(
        self,
        lamp: Lamp,
        z: Tensor,  # [...] range
    ) -> Tensor:
        """[..., 3] of what is seen there, over that in which J is its colour."""
        nearer = (lamp.range / z.clamp_min(NEAREST_LIT * lamp.range)).pow(lamp.power)
        beam = nearer[..., None] * torch.exp(-_optical_depth(self.beta_a, z))
        return 1.0 - lamp.share + lamp.share * beam

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
