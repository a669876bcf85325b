"""The network as a whole: one encoding a picture, one decoding a pair (paper, Sec. 3.1).

``Mast3r.encode`` and ``Mast3r.decode`` are what is exported, each with a fixed picture size.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# --------------------------------------------------------------------------------------------------
# Sizes of the network: the public checkpoint's, and a tiny one of the same code for tests.

PATCH_PX = 16
"""Side of the square that one token stands for; sides of a picture are multiples of it."""


@dataclass(frozen=True)
class Mast3rSize:
    """Depths and widths; the defaults are those of ViT-L / ViT-B, catmlp + dpt, pts3d + desc24."""

    encoder_depth: int = 24
    encoder_width: int = 1024
    encoder_heads: int = 16
    decoder_depth: int = 12
    decoder_width: int = 768
    decoder_heads: int = 12
    mlp_ratio: int = 4
    rotary_base: float = 100.0
    level_widths: tuple[int, int, int, int] = (96, 192, 384, 768)
    """Of the dense head's pyramid, from fine to coarse."""
    fused_width: int = 256
    """Of the dense head's fusion."""
    head_width: int = 128
    """Of the dense head's last hidden layer."""
    descriptor: int = 24

    @property
    def hooks(self) -> tuple[int, int, int, int]:
        """Layers the dense head reads: the encoding, and after 1/2, 3/4 and all of decoding."""
        depth = self.decoder_depth
        return 0, depth // 2, depth * 3 // 4, depth


FULL = Mast3rSize()
"""The public checkpoint: 1,017 tensors, 695 million numbers."""

TINY = Mast3rSize(
    encoder_depth=2,
    encoder_width=48,
    encoder_heads=3,
    decoder_depth=4,
    decoder_width=32,
    decoder_heads=2,
    level_widths=(8, 12, 16, 24),
    fused_width=16,
    head_width=8,
    descriptor=6,
)
"""For tests: the same code in a second."""


# --------------------------------------------------------------------------------------------------
# The network.

MEAN = STD = 0.5
"""Of the pixel values that the checkpoint was trained on."""

SHORTEST = 1e-8
"""Raw length below which a point has no direction."""

LONGEST = 30.0
"""Raw length beyond which expm1 is not followed: e^30 is 1e13 units, and stays a number."""


class ViewGeometry(NamedTuple):
    """What the network says of one view, pointmap in the frame of view a."""

    X: Tensor
    """[B, H, W, 3]"""
    Q: Tensor
    """[B, H, W] confidence of the points, above 1"""
    D: Tensor
    """[B, H, W, d] descriptors of unit length"""
    C: Tensor
    """[B, H, W] confidence of the descriptors, above 0"""


class PatchEmbed(nn.Module):
    """Squares of pixels -> tokens."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH_PX, stride=PATCH_PX)

    def forward(
        self,
        image: Tensor,  # [B, 3, H, W] normalised
    ) -> Tensor:
        """[B, N, D] row by row"""
        return self.proj(image).flatten(2).transpose(1, 2)  # type: ignore[no-any-return]


class PointHead(nn.Module):
    """Dense head for the points, an MLP on the tokens for the descriptors."""

    def __init__(self, size: Mast3rSize) -> None:
        super().__init__()
        both = size.encoder_width + size.decoder_width
        values = (size.descriptor + 1) * PATCH_PX**2
        self.dpt = DenseHead(size)
        self.head_local_features = Mlp(both, size.mlp_ratio * both, values)

    def forward(
        self,
        layers: list[Tensor],  # four of [B, N, D]
        rows: int,
        columns: int,
    ) -> ViewGeometry:
        """Raw outputs made into points, unit descriptors and confidences."""
        dense = self.dpt(layers, rows, columns)
        tokens = self.head_local_features(torch.cat([layers[0], layers[-1]], dim=-1))
        grid = tokens.transpose(1, 2).reshape(len(tokens), -1, rows, columns)
        local = F.pixel_shuffle(grid, PATCH_PX).permute(0, 2, 3, 1)
        points = dense.permute(0, 2, 3, 1)
        raw, confidence = points[..., :3], points[..., 3]
        length = torch.linalg.vector_norm(raw, dim=-1, keepdim=True)
        reach = torch.expm1(length.clamp(max=LONGEST))
        return ViewGeometry(
            raw / length.clamp_min(SHORTEST) * reach,
            1.0 + confidence.clamp(max=LONGEST).exp(),
            F.normalize(local[..., :-1], dim=-1),
            local[..., -1].clamp(max=LONGEST).exp(),
        )


class Mast3r(nn.Module):
    """Siamese encoder, two decoders that look at each other, a head each."""

    def __init__(self, size: Mast3rSize = FULL) -> None:
        super().__init__()
        self.size, wide, narrow = size, size.encoder_width, size.decoder_width
        heads, ratio = size.decoder_heads, size.mlp_ratio
        # Left from the checkpoint's own pre-training; nothing reads it.
        self.mask_token = nn.Parameter(torch.zeros(1, 1, narrow))
        self.patch_embed = PatchEmbed(wide)
        self.enc_blocks = nn.ModuleList(
            EncoderBlock(wide, size.encoder_heads, ratio) for _ in range(size.encoder_depth)
        )
        self.enc_norm = nn.LayerNorm(wide, eps=NORM_EPS)
        self.decoder_embed = nn.Linear(wide, narrow)
        self.dec_blocks = nn.ModuleList(
            DecoderBlock(narrow, heads, ratio) for _ in range(size.decoder_depth)
        )
        self.dec_norm = nn.LayerNorm(narrow, eps=NORM_EPS)
        self.dec_blocks2 = nn.ModuleList(
            DecoderBlock(narrow, heads, ratio) for _ in range(size.decoder_depth)
        )
        self.downstream_head1 = PointHead(size)
        self.downstream_head2 = PointHead(size)

    def encode(
        self,
        image: Tensor,  # [B, 3, H, W] RGB in [0, 1], H and W multiples of 16
    ) -> Tensor:
        """[B, N, encoder width] tokens of a picture, row by row; computed once and cached."""
        rows, columns = image.shape[-2] // PATCH_PX, image.shape[-1] // PATCH_PX
        table = self._table(rows, columns, self.size.encoder_width // self.size.encoder_heads)
        x = self.patch_embed((image - MEAN) / STD)
        for block in self.enc_blocks:
            x = block(x, table)
        return self.enc_norm(x)  # type: ignore[no-any-return]

    def decode(
        self,
        a: Tensor,  # [B, N, encoder width] tokens of the reference view
        b: Tensor,  # [B, N, encoder width] tokens of the other
        rows: int,
        columns: int,
    ) -> tuple[ViewGeometry, ViewGeometry]:
        """Geometry of both views in the frame of a."""
        table = self._table(rows, columns, self.size.decoder_width // self.size.decoder_heads)
        layers_a, layers_b = [a], [b]
        x, y = self.decoder_embed(a), self.decoder_embed(b)
        for first, second in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            x, y = first(x, y, table, table), second(y, x, table, table)
            layers_a.append(x)
            layers_b.append(y)
        layers_a[-1], layers_b[-1] = self.dec_norm(x), self.dec_norm(y)
        # Points are exponentials of what the heads say: they are computed in 32 bits, as in the
        # published network, whatever precision the blocks run in.
        read_a, read_b = (
            [layers[i].float() for i in self.size.hooks] for layers in (layers_a, layers_b)
        )
        with _without_autocast(a.device):
            return (
                self.downstream_head1(read_a, rows, columns),
                self.downstream_head2(read_b, rows, columns),
            )

    def forward(
        self,
        image_a: Tensor,  # [B, 3, H, W] RGB in [0, 1]
        image_b: Tensor,  # [B, 3, H, W]
    ) -> tuple[ViewGeometry, ViewGeometry]:
        """Both views in the frame of a."""
        rows, columns = image_a.shape[-2] // PATCH_PX, image_a.shape[-1] // PATCH_PX
        return self.decode(self.encode(image_a), self.encode(image_b), rows, columns)

    def _table(self, rows: int, columns: int, head_width: int) -> RotaryTable:
        table = rotary_table(rows, columns, head_width, self.size.rotary_base)
        device = self.mask_token.device
        return RotaryTable(table.cosine.to(device), table.sine.to(device))


def _without_autocast(device: torch.device) -> AbstractContextManager[object]:
    """32 bits; there is nothing to leave on a device without autocast, such as meta."""
    if not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


# --------------------------------------------------------------------------------------------------
# Transformer blocks of encoder and decoders: pre-norm, rotary attention, GELU.
#
# Attribute names are those of the public checkpoint's tensors.

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


# --------------------------------------------------------------------------------------------------
# Rotary position embedding in two dimensions (RoPE; Su et al. 2021, here by row and column).
#
# The first half of a head's channels turns with the token's row, the second with its column. The
# angles are a table of the picture's size, so that an exported graph holds them as a constant.


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


# --------------------------------------------------------------------------------------------------
# From tokens to pixels: the dense prediction head (DPT; Ranftl et al. 2021).
#
# Four layers of tokens become a pyramid, which is fused from coarse to fine. Attribute names are
# those of the public checkpoint's tensors; its ``layer_rn`` repeats ``layer1_rn`` ...
# ``layer4_rn``.

POINT_AND_CONFIDENCE = 4
"""Channels: x, y, z and a confidence."""


class ResidualConvUnit(nn.Module):
    """Two convolutions that add to what they are given."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(
        self,
        x: Tensor,  # [B, C, h, w]
    ) -> Tensor:
        """[B, C, h, w]"""
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))  # type: ignore[no-any-return]


class FeatureFusion(nn.Module):
    """Adds a finer level of the pyramid to what came from below, and doubles the size."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(width, width, 1)
        self.resConfUnit1 = ResidualConvUnit(width)
        self.resConfUnit2 = ResidualConvUnit(width)

    def forward(
        self,
        x: Tensor,  # [B, C, h, w]
        level: Tensor | None = None,  # [B, C, h, w]; None at the coarsest
    ) -> Tensor:
        """[B, C, 2h, 2w]"""
        if level is not None:
            x = x + self.resConfUnit1(level)
        return self.out_conv(double(self.resConfUnit2(x)))  # type: ignore[no-any-return]


class Doubled(nn.Module):
    """``double`` as a layer of a sequence."""

    def forward(
        self,
        x: Tensor,  # [B, C, h, w]
    ) -> Tensor:
        """[B, C, 2h, 2w]"""
        return double(x)


class Scratch(nn.Module):
    """The layers that fuse the pyramid."""

    def __init__(self, size: Mast3rSize) -> None:
        super().__init__()
        fused = size.fused_width
        levels = [nn.Conv2d(n, fused, 3, padding=1, bias=False) for n in size.level_widths]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = levels
        self.layer_rn = nn.ModuleList(levels)
        self.refinenet1 = FeatureFusion(fused)
        self.refinenet2 = FeatureFusion(fused)
        self.refinenet3 = FeatureFusion(fused)
        self.refinenet4 = FeatureFusion(fused)

    def forward(
        self,
        pyramid: Sequence[Tensor],  # four of [B, C, h, w], from fine to coarse
    ) -> Tensor:
        """[B, C, 2h, 2w] twice the finest level's size."""
        first, second, third, fourth = (
            conv(level) for conv, level in zip(self.layer_rn, pyramid, strict=True)
        )
        height, width = third.shape[-2:]  # an odd number of tokens was rounded up when halved
        fused = self.refinenet4(fourth)[..., :height, :width]
        fused = self.refinenet2(self.refinenet3(fused, third), second)
        return self.refinenet1(fused, first)  # type: ignore[no-any-return]


class DenseHead(nn.Module):
    """Tokens of four layers -> raw point and confidence of every pixel."""

    def __init__(self, size: Mast3rSize) -> None:
        super().__init__()
        n1, n2, n3, n4 = size.level_widths
        wide, narrow = size.encoder_width, size.decoder_width
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(wide, n1, 1), nn.ConvTranspose2d(n1, n1, 4, stride=4)),
                nn.Sequential(nn.Conv2d(narrow, n2, 1), nn.ConvTranspose2d(n2, n2, 2, stride=2)),
                nn.Sequential(nn.Conv2d(narrow, n3, 1)),
                nn.Sequential(nn.Conv2d(narrow, n4, 1), nn.Conv2d(n4, n4, 3, stride=2, padding=1)),
            ]
        )
        self.scratch = Scratch(size)
        self.head = nn.Sequential(
            nn.Conv2d(size.fused_width, size.fused_width // 2, 3, padding=1),
            Doubled(),
            nn.Conv2d(size.fused_width // 2, size.head_width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(size.head_width, POINT_AND_CONFIDENCE, 1),
        )

    def forward(
        self,
        layers: Sequence[Tensor],  # four of [B, N, D]
        rows: int,
        columns: int,
    ) -> Tensor:
        """[B, 4, 16 rows, 16 columns]"""
        grids = [x.transpose(1, 2).reshape(len(x), -1, rows, columns) for x in layers]
        levels = zip(self.act_postprocess, grids, strict=True)
        return self.head(self.scratch([stage(grid) for stage, grid in levels]))  # type: ignore[no-any-return]


def double(
    x: Tensor,  # [B, C, h, w]
) -> Tensor:
    """[B, C, 2h, 2w] bilinear, corner to corner."""
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
