"""The Gaussians of one sub-map: explicit parameters, each tied to the keyframe that saw it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

COLOUR_SHARPNESS = 10.0
"""Softplus sharpness that keeps radiance positive and is the identity above about 0.3."""

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

    def __init__(self, local_width: int = 0) -> None:
        self.parameters = {name: torch.zeros(0, self.WIDTHS[name]) for name in self.NAMES}
        self.keyframes = torch.zeros(0, dtype=torch.int64)
        """[N] number of the keyframe each Gaussian belongs to."""
        self.local_features = torch.zeros(0, local_width)
        """[N, F] what a decoder knows of each Gaussian, zero to begin with; F = 0 without one."""

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def means(self) -> Tensor:
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

    def extend(self, new: Mapping[str, Tensor], keyframe: int) -> None:
        """Append Gaussians (tensors by the names above) that ``keyframe`` saw."""
        count = len(new["means"])
        for name in self.NAMES:
            self.parameters[name] = torch.cat([self.parameters[name], new[name]]).contiguous()
        owner = torch.full((count,), keyframe, dtype=torch.int64)
        self.keyframes = torch.cat([self.keyframes, owner])
        self._extend_features(count)

    def append(self, other: GaussianMap) -> None:
        """Append all Gaussians of ``other``, which keep their keyframes but not their features."""
        for name in self.NAMES:
            both = [self.parameters[name], other.parameters[name]]
            self.parameters[name] = torch.cat(both).contiguous()
        self.keyframes = torch.cat([self.keyframes, other.keyframes])
        self._extend_features(len(other))

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False."""
        for name in self.NAMES:
            self.parameters[name] = self.parameters[name][mask].contiguous()
        self.keyframes = self.keyframes[mask]
        self.local_features = self.local_features[mask].contiguous()

    def _extend_features(self, count: int) -> None:
        new = self.local_features.new_zeros(count, self.local_features.shape[1])
        self.local_features = torch.cat([self.local_features, new]).contiguous()


def radiance(
    raw: Tensor,  # [..., 3]
) -> Tensor:
    """Positive radiance of raw colours."""
    return torch.nn.functional.softplus(raw, beta=COLOUR_SHARPNESS)


def raw_colour(
    colour: Tensor,  # [..., 3] >= 0
) -> Tensor:
    """Raw colours whose :func:`radiance` is ``colour``."""
    # softplus_beta^-1(y) = y + log(1 - exp(-beta y)) / beta, with y kept off zero.
    y = colour.clamp_min(MIN_RADIANCE)
    return y + torch.log(-torch.expm1(-COLOUR_SHARPNESS * y)) / COLOUR_SHARPNESS
