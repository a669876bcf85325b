"""The Gaussians of one sub-map: explicit parameters, each tied to the keyframe that saw it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from aquaflow.render.activation import COLOUR_SHARPNESS, radiance
from aquaflow.render.contract import CPU

MIN_RADIANCE = 1e-3
"""Darker colours start here: black itself has no finite raw colour."""


class GaussianMap:
    """Parameters as the optimiser sees them, and as the renderer wants them.

    ``means`` [N, 3] world; ``quats`` [N, 4] wxyz, not normalised; ``log_scales`` [N, 3];
    ``opacity_logits`` [N, 1]; ``raw_colours`` [N, 3], softplus of which is the clean radiance J.
    """

    NAMES = ("means", "quats", "log_scales", "opacity_logits", "raw_colours")
    WIDTHS: Mapping[str, int] = {
        "means": 3,
        "quats": 4,
        "log_scales": 3,
        "opacity_logits": 1,
        "raw_colours": 3,
    }

    def __init__(self, local_width: int = 0, device: torch.device = CPU) -> None:
        self.device = device
        self.parameters = {
            name: torch.zeros(0, self.WIDTHS[name], device=device) for name in self.NAMES
        }
        self.keyframes = torch.zeros(0, dtype=torch.int64, device=device)
        """[N] number of the keyframe each Gaussian belongs to."""
        self.local_features = torch.zeros(0, local_width, device=device)
        """[N, F] what a decoder knows of each Gaussian, zero to begin with; F = 0 without one."""

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def means(self) -> Tensor:
        """[N, 3] centres, world."""
        return self.parameters["means"]

    @property
    def scales(self) -> Tensor:
        """[N, 3] standard deviations, map units."""
        return torch.exp(self.parameters["log_scales"])

    @property
    def opacities(self) -> Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.parameters["opacity_logits"][:, 0])

    @property
    def colours(self) -> Tensor:
        """[N, 3] clean radiance J >= 0."""
        return radiance(self.parameters["raw_colours"])

    def extend(
        self,
        new: Mapping[str, Tensor],  # each [M, ...]
        keyframe: int,
    ) -> None:
        """Append Gaussians (tensors by the names above) that ``keyframe`` saw."""
        size = (len(new["means"]),)
        self._grow(new, torch.full(size, keyframe, dtype=torch.int64, device=self.device))

    def append(self, other: GaussianMap) -> None:
        """Append all Gaussians of ``other``, which keep their keyframes but not their features."""
        self._grow(other.parameters, other.keyframes)

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False."""
        rows = torch.nonzero(mask)[:, 0]  # once for all tensors
        self._replace(
            {name: self.parameters[name][rows].contiguous() for name in self.NAMES},
            self.keyframes[rows],
            self.local_features[rows].contiguous(),
        )

    def _grow(
        self,
        new: Mapping[str, Tensor],  # each [M, ...]
        keyframes: Tensor,  # [M] int64
    ) -> None:
        features = self.local_features.new_zeros(len(keyframes), self.local_features.shape[1])
        self._replace(
            {n: torch.cat([self.parameters[n], new[n]]).contiguous() for n in self.NAMES},
            torch.cat([self.keyframes, keyframes]),
            torch.cat([self.local_features, features]).contiguous(),
        )

    def _replace(
        self,
        parameters: dict[str, Tensor],  # each [N, ...]
        keyframes: Tensor,  # [N] int64
        features: Tensor,  # [N, F]
    ) -> None:
        """All tables at once, when all are made: a failure leaves them as they were.

        Raises:
            ArithmeticError: a Gaussian is not finite; one alone would spoil every later step.
        """
        finite = [torch.isfinite(tensor).all() for tensor in parameters.values()]
        if not bool(torch.stack(finite).all()):
            raise ArithmeticError("a Gaussian is not finite")
        self.parameters, self.keyframes, self.local_features = parameters, keyframes, features


def raw_colour(
    colour: Tensor,  # [..., 3] >= 0
) -> Tensor:
    """Raw colours whose :func:`~aquaflow.render.activation.radiance` is ``colour``."""
    # softplus_beta^-1(y) = y + log(1 - exp(-beta y)) / beta, with y kept off zero.
    y = colour.clamp_min(MIN_RADIANCE)
    return y + torch.log(-torch.expm1(-COLOUR_SHARPNESS * y)) / COLOUR_SHARPNESS
