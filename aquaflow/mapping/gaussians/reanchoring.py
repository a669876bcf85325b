"""The map follows its keyframes: Gaussians and views move by the full similarity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch

from aquaflow.geometry.similarity import Sim3, Sim3Batch, on_so3
from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.render.transfers import moves_in
from aquaflow.render.views import View


@torch.no_grad()
def move_gaussians(gaussians: GaussianMap, moves: Mapping[int, Sim3]) -> torch.Tensor:
    """Move what belongs to the keyframes in ``moves``, place, orientation and size, in place.

    ``moves`` holds for a keyframe's number the similarity that maps its old world to its new one.
    Returns the rows [M] that were moved; the cost grows with M.

    Raises:
        ArithmeticError: where they go is not finite; nothing has moved then.
    """
    if not moves or len(gaussians) == 0:
        return torch.zeros(0, dtype=torch.int64, device=gaussians.device)
    ordered = [moves[number] for number in sorted(moves)]
    columns = (
        [S.R for S in ordered], [S.t for S in ordered], [S.quaternion for S in ordered],
        [S.scale for S in ordered],
    )  # fmt: skip
    numbers, *tables = (
        moves_in(torch.from_numpy(np.stack(column)), gaussians.device)
        for column in (sorted(moves), *columns)
    )
    rows = torch.nonzero(torch.isin(gaussians.keyframes, numbers))[:, 0]
    which = torch.searchsorted(numbers, gaussians.keyframes[rows])
    R, t, turn, scale = (table[which] for table in tables)
    scale = scale[:, None]
    means, quats = (gaussians.parameters[name] for name in ("means", "quats"))
    turned = torch.einsum("nij,nj->ni", R, means[rows].double())
    moved = (scale * turned + t).float()
    facing = quaternion_product(turn, quats[rows].double()).float()
    growth = torch.log(scale).float()
    if not all(bool(torch.isfinite(each).all()) for each in (moved, facing, growth)):
        raise ArithmeticError("a correction of the map is not finite")
    means[rows], quats[rows] = moved, facing
    gaussians.parameters["log_scales"][rows] += growth
    return rows


def move_views(views: Iterable[View], moves: Mapping[int, Sim3]) -> None:
    """Re-anchor the views of the keyframes in ``moves``.

    Raises:
        ArithmeticError: where they go is not finite; no view has moved then.
    """
    moving = [view for view in views if view.keyframe in moves]
    if not moving:
        return
    # All at once: one by one, the 2000 views of two joined lines would take half a second.
    before = Sim3Batch.of([view.T_wc for view in moving])
    moved = Sim3Batch.of([moves[view.keyframe] for view in moving]) @ before
    moved = replace(moved, R=on_so3(moved.R))
    poses = [moved.element(i).if_finite() for i in range(len(moving))]
    for view, T_wc in zip(moving, poses, strict=True):
        view.T_wc = T_wc


def quaternion_product(
    a: torch.Tensor,  # [N, 4] wxyz
    b: torch.Tensor,  # [N, 4] wxyz
) -> torch.Tensor:
    """[N, 4]: the rotation b, then the rotation a."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=1)
