"""The sinusoidal encoding gamma of the paper (Eq. 7)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

BANDS = 4
"""L in the paper."""


def sinusoidal_encoding(
    x: Tensor,  # [..., D]
    bands: int = BANDS,
) -> Tensor:
    """[..., D (1 + 2 L)]: x, then sin and cos of 2^l pi x for l below ``bands``."""
    parts = [x]
    for level in range(bands):
        angle = (2.0**level * math.pi) * x
        parts += [torch.sin(angle), torch.cos(angle)]
    return torch.cat(parts, dim=-1)
