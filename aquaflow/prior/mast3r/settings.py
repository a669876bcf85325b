"""Sizes of the network: the public checkpoint's, and a tiny one of the same code for tests."""

from __future__ import annotations

from dataclasses import dataclass

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
