"""Pairs of pictures of a plane, with matches that can be worked out by hand."""

from __future__ import annotations

import torch

from aquaflow.lab.training.pairs import Pair, ViewBatch

FOCAL_PX = 20.0


def camera_at(x: float, turned: float = 0.0) -> torch.Tensor:
    """[4, 4] a camera at (x, 0, 0), turned about its vertical axis, radians."""
    T = torch.eye(4, dtype=torch.float64)
    angle = torch.tensor(turned, dtype=torch.float64)
    T[0, 0] = T[2, 2] = angle.cos()
    T[0, 2], T[2, 0] = angle.sin(), -angle.sin()
    T[0, 3] = x
    return T


def plane_view(x: float, z: float = 2.0, turned: float = 0.0, size: int = 20) -> ViewBatch:
    """A square picture of the plane at depth ``z``, seen by a camera shifted to ``x``."""
    K = torch.tensor([[FOCAL_PX, 0, size / 2], [0, FOCAL_PX, size / 2], [0, 0, 1]]).double()
    depth = torch.full((1, size, size), z, dtype=torch.float64)
    image = torch.zeros(1, 3, size, size, dtype=torch.float64)
    return ViewBatch(image, depth, K[None], camera_at(x, turned)[None], depth > 0)


def shifted_pair(x: float, z: float = 2.0) -> Pair:
    """The second camera stands ``x`` metres to the right of the first."""
    return Pair(plane_view(0.0, z), plane_view(x, z))
