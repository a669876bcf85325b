"""The network as a whole: one encoding a picture, one decoding a pair (paper, Sec. 3.1).

``Mast3r.encode`` and ``Mast3r.decode`` are what is exported, each with a fixed picture size.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aquaflow.prior.mast3r.blocks import NORM_EPS, DecoderBlock, EncoderBlock, Mlp
from aquaflow.prior.mast3r.dense_head import DenseHead
from aquaflow.prior.mast3r.rotary import RotaryTable, rotary_table
from aquaflow.prior.mast3r.settings import FULL, PATCH_PX, Mast3rSize

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
        read_a, read_b = ([layers[i] for i in self.size.hooks] for layers in (layers_a, layers_b))
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
