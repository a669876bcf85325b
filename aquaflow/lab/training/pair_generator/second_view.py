"""A second look at a picture: turned, zoomed and shifted about the same centre of projection.

What a turned camera sees follows from the picture exactly, depth included, so that one rendered
view gives many, and a view with itself gives pairs of a homography with exact matches.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pairs import ViewBatch

SMOOTH = 1.1
"""Ratio of neighbouring depths above which a depth between them is that of neither."""


def turned_view(
    view: ViewBatch,
    K: Tensor,  # [B, 3, 3] of the new picture
    R: Tensor,  # [B, 3, 3] new camera to old
    width: int,
    height: int,
) -> ViewBatch:
    """The view through another camera at the same place; beyond the picture it is mirrored."""
    T_wc = view.T_wc.clone()
    T_wc[:, :3, :3] = view.T_wc[:, :3, :3] @ R
    empty = torch.zeros(len(K), height, width, device=K.device)
    rays = ViewBatch(view.image, empty, K, T_wc, empty > 0).rays(height, width) @ R[:, None].mT
    old = rays[..., :2] / rays[..., 2:].clamp_min(1e-3)
    focal = torch.stack([view.K[:, 0, 0], view.K[:, 1, 1]], -1)[:, None, None]
    pixels = old * focal + view.K[:, None, None, :2, 2]
    size = torch.tensor(view.depth.shape[:-3:-1], device=K.device)
    grid = pixels / size * 2.0 - 1.0
    image = F.grid_sample(view.image, grid, padding_mode="reflection", align_corners=False)
    # Inverse depth is linear in the pixels of a plane.
    inverse = torch.where(view.valid, 1.0 / view.depth.clamp_min(1e-3), 0.0)
    known = torch.stack([inverse, (view.valid & ~_edges(view)).float()], 1)
    inverse, clear = F.grid_sample(known, grid, align_corners=False).unbind(1)
    inside = ((pixels > 0.5) & (pixels < size - 0.5)).all(-1) & (rays[..., 2] > 1e-3)
    depth = 1.0 / (inverse * rays[..., 2]).clamp_min(1e-3)
    # Water is drawn over all of the picture, so the mirrored part has a depth too.
    mirrored = F.grid_sample(
        view.depth[:, None], grid, mode="nearest", padding_mode="reflection", align_corners=False
    )[:, 0]
    valid = inside & (clear > 0.999)
    return ViewBatch(image, torch.where(valid, depth, mirrored), K, T_wc, valid)


def _edges(view: ViewBatch) -> Tensor:
    """[B, H, W] bool: one of the four neighbours differs in depth, or is not known."""
    across = _differ(view.depth[:, :, 1:], view.depth[:, :, :-1])
    down = _differ(view.depth[:, 1:], view.depth[:, :-1])
    across = F.pad(across, (1, 0)) | F.pad(across, (0, 1))
    return across | F.pad(down, (0, 0, 1, 0)) | F.pad(down, (0, 0, 0, 1))


def _differ(
    one: Tensor,  # [B, h, w] m
    other: Tensor,  # [B, h, w] m
) -> Tensor:
    return (one > SMOOTH * other) | (other > SMOOTH * one)
