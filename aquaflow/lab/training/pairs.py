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


# --------------------------------------------------------------------------------------------------
# True matches of a pair: pixels whose points lie at one place (paper, Sec. 3.1).

SAME_PLACE = 0.03
"""Distance of two points, as a share of their depth, below which they are one: a pixel's step on a
surface seen at 60 degrees, 100 px to the radian, is 0.02."""

NEAREST_DEPTH = 1e-6
"""Metres in front of the camera below which a point has no picture."""


@dataclass(frozen=True)
class Correspondences:
    """Where each pixel of a is seen in b."""

    pixels: Tensor
    """[B, H, W, 2] px"""
    visible: Tensor
    """[B, H, W] bool: on b's picture, and nothing of b stands in front"""


def correspondences(pair: Pair) -> Correspondences:
    """By projecting a's points into b and comparing them with b's own points there."""
    a, b = pair.a, pair.b
    points = seen_from(b.T_wc, a.points(), a.T_wc)
    pixels, inside = project(points, b)
    rows, columns = nearest_pixels(pixels, b)
    batch = torch.arange(len(pixels), device=pixels.device)[:, None, None]
    there = b.points()[batch, rows, columns]
    distance = torch.linalg.vector_norm(points - there, dim=-1)
    same = distance < SAME_PLACE * points[..., 2]
    return Correspondences(pixels, inside & same & a.valid & b.valid[batch, rows, columns])


def project(
    points: Tensor,  # [B, H, W, 3] in the view's frame
    view: ViewBatch,
) -> tuple[Tensor, Tensor]:
    """[B, H, W, 2] px and [B, H, W] bool: in front of the camera and on the picture."""
    z = points[..., 2]
    focal = torch.stack([view.K[:, 0, 0], view.K[:, 1, 1]], -1)[:, None, None]
    pixels = focal * points[..., :2] / z.clamp_min(NEAREST_DEPTH)[..., None]
    pixels = pixels + view.K[:, None, None, :2, 2]
    size = torch.tensor(view.depth.shape[:-3:-1], device=z.device)
    inside = (z > NEAREST_DEPTH) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return pixels, inside


def nearest_pixels(
    pixels: Tensor,  # [B, H, W, 2]
    view: ViewBatch,
) -> tuple[Tensor, Tensor]:
    """Row and column, both [B, H, W] int64, held on the picture."""
    height, width = view.depth.shape[-2:]
    columns, rows = pixels.nan_to_num().floor().long().unbind(-1)
    return rows.clamp(0, height - 1), columns.clamp(0, width - 1)


def overlap(pair: Pair) -> Tensor:
    """[B] share of the valid pixels that the other view sees, the smaller of both directions."""
    shares = []
    for way in (pair, pair.swap()):
        seen = correspondences(way).visible.flatten(1).sum(1)
        shares.append(seen / way.a.valid.flatten(1).sum(1).clamp_min(1))
    return torch.minimum(*shares)
