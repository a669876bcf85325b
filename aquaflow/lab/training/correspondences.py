"""True matches of a pair: pixels whose points lie at one place (paper, Sec. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.lab.training.pairs import Pair, ViewBatch, seen_from

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
