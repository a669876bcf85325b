"""What a prior is trained on: two pictures of one scene, their depths and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass(frozen=True)
class ViewBatch:
    """A batch of pictures with all that is known of them."""

    image: Tensor
    """[B, 3, H, W] RGB in [0, 1]"""
    depth: Tensor
    """[B, H, W] z along the optical axis, metres; not positive where unknown"""
    K: Tensor
    """[B, 3, 3] px, pixel centres at half-integers"""
    T_wc: Tensor
    """[B, 4, 4] camera to world"""
    valid: Tensor
    """[B, H, W] bool: depth is known, and the pixel shows neither the moving nor the shiny"""

    def points(self) -> Tensor:
        """[B, H, W, 3] in the camera's frame."""
        height, width = self.depth.shape[-2:]
        return self.rays(height, width) * self.depth[..., None]

    def rays(self, height: int, width: int) -> Tensor:
        """[B, H, W, 3] direction of each pixel's centre, z = 1."""
        options = {"dtype": self.depth.dtype, "device": self.depth.device}
        v = torch.arange(height, **options) + 0.5  # type: ignore[call-overload]
        u = torch.arange(width, **options) + 0.5  # type: ignore[call-overload]
        fx, fy = self.K[:, 0, 0, None, None], self.K[:, 1, 1, None, None]
        cx, cy = self.K[:, 0, 2, None, None], self.K[:, 1, 2, None, None]
        x = ((u - cx) / fx).expand_as(self.depth)
        y = ((v[:, None] - cy) / fy).expand_as(self.depth)
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)

    def to(self, device: torch.device) -> ViewBatch:
        """The same on another device."""
        return ViewBatch(*(getattr(self, field.name).to(device) for field in fields(self)))


FIELDS = fields(ViewBatch)
"""Of a view, by which batches are taken apart and joined."""


@dataclass(frozen=True)
class Pair:
    """Two views of one scene; a is the reference."""

    a: ViewBatch
    b: ViewBatch

    def swap(self) -> Pair:
        """The same pair, seen from b."""
        return Pair(self.b, self.a)

    def to(self, device: torch.device) -> Pair:
        """The same on another device."""
        return Pair(self.a.to(device), self.b.to(device))


def join(pairs: Sequence[Pair]) -> Pair:
    """One batch of several, of pictures of one size."""
    return Pair(joined_views([pair.a for pair in pairs]), joined_views([pair.b for pair in pairs]))


def joined_views(views: Sequence[ViewBatch]) -> ViewBatch:
    """One batch of several, of pictures of one size."""
    parts = ([getattr(view, field.name) for view in views] for field in FIELDS)
    return ViewBatch(*map(torch.cat, parts))


def seen_from(
    T_wc: Tensor,  # [B, 4, 4] of the camera that looks
    points: Tensor,  # [B, H, W, 3] in the frame of another camera
    T_wc_points: Tensor,  # [B, 4, 4] of that camera
) -> Tensor:
    """[B, H, W, 3] the points in the frame of the camera that looks."""
    T = torch.linalg.solve(T_wc, T_wc_points)
    moved: Tensor = points @ T[:, None, :3, :3].mT + T[:, None, None, :3, 3]
    return moved


def true_pointmaps(pair: Pair) -> tuple[Tensor, Tensor]:
    """[B, H, W, 3] X_a and X_b, both in the frame of a: what the network is to predict."""
    return pair.a.points(), seen_from(pair.a.T_wc, pair.b.points(), pair.b.T_wc)
