"""Voxel groups made anew: after a failure that left their tables half changed, or in voxels of
another size."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from aquaflow.render.transfers import groups_out


def is_whole(
    groups: VoxelGroups,
    count: int,  # N Gaussians in the map
) -> bool:
    """True if every Gaussian has one place in one group, and all tables agree."""
    group, slot, table = groups.group, groups.slot, groups.table
    if len(group) != count or len(slot) != count:
        return False
    if not len(groups) == len(table) == len(groups.voxel) == len(groups.features):
        return False
    inside = (group >= 0) & (group < len(groups)) & (slot >= 0) & (slot < table.shape[1])
    rows = torch.arange(count, device=groups.device)
    if not bool(inside.all()) or not torch.equal(table[group, slot], rows):
        return False
    taken = (table != EMPTY).sum(1)
    numbers = torch.arange(len(groups), device=groups.device)
    listed = torch.equal(torch.sort(groups.order()).values, numbers)
    return listed and torch.equal(taken, groups.fill) and int(taken.sum()) == count


def regrouped(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3] of all Gaussians
) -> VoxelGroups:
    """All Gaussians placed anew; a voxel's first group keeps the feature known of that voxel."""
    new = _placed(groups, means, groups.size)
    known: dict[int, Tensor] = {}
    for voxel, feature in zip(groups_out(groups.voxel), groups.features, strict=False):
        known.setdefault(voxel, feature)
    for group, voxel in enumerate(groups_out(new.voxel)):
        feature = known.pop(voxel, None)
        if feature is not None and bool(torch.isfinite(feature).all()):
            new.features[group] = feature
    return new


def resized(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3] of all Gaussians
    size: float,
) -> VoxelGroups:
    """All Gaussians in voxels of ``size`` map units; a new group takes over the feature that its
    first Gaussian's had."""
    new = _placed(groups, means, size)
    if len(new):
        new.features.copy_(groups.features[groups.group[new.table[:, 0]]])
    return new


def _placed(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3]
    size: float,
) -> VoxelGroups:
    new = VoxelGroups(groups.config, groups.features.shape[1], groups.device)
    new.size = size
    new.insert(means)
    return new
