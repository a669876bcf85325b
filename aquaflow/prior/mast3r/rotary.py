"""Rotary position embedding in two dimensions (RoPE; Su et al. 2021, here by row and column).

The first half of a head's channels turns with the token's row, the second with its column. The
angles are a table of the picture's size, so that an exported graph holds them as a constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class RotaryTable:
    """Cosines and sines of all tokens of a picture."""

    cosine: Tensor
    """[N, d]"""
    sine: Tensor
    """[N, d]"""

    def turn(
        self,
        x: Tensor,  # [B, heads, N, d]
    ) -> Tensor:
        """[B, heads, N, d] queries or keys, turned by where their tokens are."""
        return x * self.cosine + _quarter_turned(x) * self.sine


def rotary_table(rows: int, columns: int, head_width: int, base: float) -> RotaryTable:
    """The table of a grid of tokens, row by row; ``head_width`` is a multiple of four."""
    channels = head_width // 2
    frequency = base ** (-torch.arange(0, channels, 2, dtype=torch.float32) / channels)
    row = torch.arange(rows, dtype=torch.float32).repeat_interleave(columns)
    column = torch.arange(columns, dtype=torch.float32).repeat(rows)
    angles = [torch.outer(place, frequency).repeat(1, 2) for place in (row, column)]
    angle = torch.cat(angles, dim=1)
    return RotaryTable(angle.cos(), angle.sin())


def _quarter_turned(
    x: Tensor,  # [..., d]
) -> Tensor:
    """[..., d] each pair (a, b) of a half's lower and upper channels becomes (-b, a)."""
    a, b, c, d = x.chunk(4, dim=-1)
    return torch.cat([-b, a, -d, c], dim=-1)
