"""Voxel groups laid out for a decoder: groups of about the same fill side by side."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from aquaflow.render.transfers import groups_in, groups_out

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
    seen = torch.zeros(len(groups), dtype=torch.int64, device=groups.device)
    chosen = torch.nonzero(seen.index_add_(0, groups.group, visible.long()))[:, 0]
    units = (groups.fill[chosen] + BUCKET - 1).div(BUCKET, rounding_mode="floor")
    units, order = torch.sort(units, stable=True)
    chosen, buckets = chosen[order], _buckets(groups, units)
    tables = [chosen[:0]]
    members = chosen.split_with_sizes([count for count, _ in buckets])
    for (_, width), each in zip(buckets, members, strict=True):
        tables.append(_table(groups, each, width).reshape(-1))
    table = torch.cat(tables)
    first = groups.table[chosen, 0].repeat_interleave(units * BUCKET, output_size=len(table))
    valid = table != EMPTY
    return Tokens(torch.where(valid, table, first), valid, chosen, buckets)


def _buckets(
    groups: VoxelGroups,
    units: Tensor,  # [B] int64 places of each group, in multiples of BUCKET
) -> tuple[tuple[int, int], ...]:
    """(groups, places a group), of the groups that are laid out; the host has to know."""
    most = -(-groups.table.shape[1] // BUCKET)
    counts = torch.zeros(most + 1, dtype=torch.int64, device=units.device)
    counts.index_add_(0, units, torch.ones_like(units))
    return tuple((n, BUCKET * unit) for unit, n in enumerate(groups_out(counts)) if n > 0)


def _table(
    groups: VoxelGroups,
    members: Tensor,  # [B]
    width: int,
) -> Tensor:
    """[B, width] rows; -1 in free places, of which a bucket may have more than a group has."""
    table = groups.table[members, :width]
    return torch.nn.functional.pad(table, (0, width - table.shape[1]), value=EMPTY)
