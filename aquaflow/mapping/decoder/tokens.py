"""Voxel groups laid out for a decoder: groups of about the same fill side by side."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.mapping.decoder.voxel_groups import EMPTY, VoxelGroups
from aquaflow.mapping.transfers import groups_in, groups_out

BUCKET = 4
"""Places in a bucket's groups are a multiple of this; padding is 10 % of the tokens on real maps
(the powers of two: 19 %)."""


@dataclass(frozen=True)
class Tokens:
    """The Gaussians of some groups, one place each, and padding."""

    rows: Tensor
    """[P] int64 Gaussian of each place; padding repeats the group's first one."""
    valid: Tensor
    """[P] bool: not padding."""
    groups: Tensor
    """[B] int64 groups in the order of the places."""
    buckets: tuple[tuple[int, int], ...]
    """(groups, places a group) of each bucket, in the order of the places."""

    @property
    def sizes(self) -> list[int]:
        """Places of each bucket."""
        return [count * width for count, width in self.buckets]

    @property
    def places_of_groups(self) -> Tensor:
        """[B] int64 places of each group."""
        flat = groups_in([number for bucket in self.buckets for number in bucket], self.rows.device)
        counts, widths = flat.reshape(-1, 2).unbind(1)
        return widths.repeat_interleave(counts)

    def places(
        self,
        visible: Tensor,  # [N] bool
    ) -> Tensor:
        """[V] int64 places of the visible Gaussians."""
        return torch.nonzero(self.valid & visible[self.rows])[:, 0]


def visible_tokens(
    groups: VoxelGroups,
    visible: Tensor,  # [N] bool
) -> Tokens:
    """All Gaussians of the groups of which one is visible: its neighbours are its context."""
    seen = torch.zeros(len(groups), dtype=torch.bool, device=groups.device)
    seen[groups.group[visible]] = True
    chosen = torch.nonzero(seen)[:, 0]
    widths = (groups.fill[chosen] + BUCKET - 1).div(BUCKET, rounding_mode="floor") * BUCKET
    widths, order = torch.sort(widths, stable=True)
    chosen = chosen[order]
    lengths, counts = torch.unique_consecutive(widths, return_counts=True)
    sizes = groups_out(counts)
    buckets = tuple(zip(sizes, groups_out(lengths), strict=True))
    tables = [chosen[:0]]
    for (_, width), members in zip(buckets, chosen.split_with_sizes(sizes), strict=True):
        tables.append(_table(groups, members, width).reshape(-1))
    table = torch.cat(tables)
    first = groups.table[chosen, 0].repeat_interleave(widths)
    valid = table != EMPTY
    return Tokens(torch.where(valid, table, first), valid, chosen, buckets)


def _table(
    groups: VoxelGroups,
    members: Tensor,  # [B]
    width: int,
) -> Tensor:
    """[B, width] rows; -1 in free places, of which a bucket may have more than a group has."""
    table = groups.table[members, :width]
    return torch.nn.functional.pad(table, (0, width - table.shape[1]), value=EMPTY)
