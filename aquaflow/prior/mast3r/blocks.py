"""Transformer blocks of encoder and decoders: pre-norm, rotary attention, GELU.

Attribute names are those of the public checkpoint's tensors.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

from aquaflow.prior.mast3r.rotary import RotaryTable

NORM_EPS = 1e-6
"""Of layer normalisation, as in the vision transformers that the checkpoint descends from."""


class Attention(nn.Module):
    """Self-attention with one projection for queries, keys and values."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(
        self,
        x: Tensor,  # [B, N, D]
        table: RotaryTable,
    ) -> Tensor:
        """[B, N, D]"""
        q, k, v = (_split(part, self.heads) for part in self.qkv(x).chunk(3, dim=-1))
        mixed = F.scaled_dot_product_attention(table.turn(q), table.turn(k), v)
        return self.proj(_merge(mixed))  # type: ignore[no-any-return]


class CrossAttention(nn.Module):
    """Queries of one view, keys and values of the other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq = nn.Linear(width, width)
        self.projk = nn.Linear(width, width)
        self.projv = nn.Linear(width, width)
        self.proj = nn.Linear(width, width)

    def forward(
        self,
        x: Tensor,  # [B, N, D]
        other: Tensor,  # [B, M, D]
        table: RotaryTable,
        other_table: RotaryTable,
    ) -> Tensor:
        """[B, N, D]"""
        q = table.turn(_split(self.projq(x), self.heads))
        k = other_table.turn(_split(self.projk(other), self.heads))
        v = _split(self.projv(other), self.heads)
        return self.proj(_merge(F.scaled_dot_product_attention(q, k, v)))  # type: ignore[no-any-return]


class Mlp(nn.Module):
    """Two layers with a GELU between."""

    def __init__(self, width: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(
        self,
        x: Tensor,  # [B, N, D]
    ) -> Tensor:
        """[B, N, out]"""
        return self.fc2(F.gelu(self.fc1(x)))  # type: ignore[no-any-return]


class EncoderBlock(nn.Module):
    """Tokens of one picture look at each other."""

    def __init__(self, width: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.mlp = Mlp(width, mlp_ratio * width, width)

    def forward(
        self,
        x: Tensor,  # [B, N, D]
        table: RotaryTable,
    ) -> Tensor:
        """[B, N, D]"""
        x = x + self.attn(self.norm1(x), table)
        return x + self.mlp(self.norm2(x))  # type: ignore[no-any-return]


class DecoderBlock(nn.Module):
    """Tokens of one view look at each other, then at the other view's."""

    def __init__(self, width: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.norm_y = nn.LayerNorm(width, eps=NORM_EPS)
        self.cross_attn = CrossAttention(width, heads)
        self.norm3 = nn.LayerNorm(width, eps=NORM_EPS)
        self.mlp = Mlp(width, mlp_ratio * width, width)

    def forward(
        self,
        x: Tensor,  # [B, N, D]
        other: Tensor,  # [B, M, D]
        table: RotaryTable,
        other_table: RotaryTable,
    ) -> Tensor:
        """[B, N, D]"""
        x = x + self.attn(self.norm1(x), table)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), table, other_table)
        return x + self.mlp(self.norm3(x))  # type: ignore[no-any-return]


def _split(
    x: Tensor,  # [B, N, D]
    heads: int,
) -> Tensor:
    """[B, heads, N, D / heads]"""
    return x.reshape(*x.shape[:-1], heads, -1).transpose(1, 2)


def _merge(
    x: Tensor,  # [B, heads, N, d]
) -> Tensor:
    """[B, N, heads d]"""
    return x.transpose(1, 2).flatten(2)
