"""From tokens to pixels: the dense prediction head (DPT; Ranftl et al. 2021).

Four layers of tokens become a pyramid, which is fused from coarse to fine. Attribute names are
those of the public checkpoint's tensors; its ``layer_rn`` repeats ``layer1_rn`` ... ``layer4_rn``.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from aquaflow.prior.mast3r.settings import Mast3rSize

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
