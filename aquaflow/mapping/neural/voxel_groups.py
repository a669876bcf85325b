"""Gaussians in groups of neighbours: voxels that are filled as the map grows (paper, Sec. 3.3.1).

A voxel is a cube of the world; a group holds at most K Gaussians of one voxel, and a voxel that
overflows opens a further group. Rows and groups are numbered by position, as in the tensors that
the optimisers hold, so whatever is dropped is dropped there with the same mask.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.config.mapping import VoxelConfig
from aquaflow.render.contract import CPU
from aquaflow.render.transfers import groups_in, groups_out

EMPTY = -1
"""Stands for no number in these tables."""

REACH = 2**20
"""Voxels counted along one axis from the origin; what lies further counts as in the last one."""

WHOLE = 2.0
"""Widest group, in voxels, that a move leaves together: a voxel turned askew spans sqrt(3)."""

MAX_EMPTY_SHARE = 0.25
"""Share of groups without Gaussians above which they are dropped: amortised, each costs once."""


class VoxelGroups:
    """Which Gaussian is in which group and slot, and the feature each group shares.

    A group's slots 0 ... fill - 1 are taken. Its Gaussians were in its voxel when they were placed;
    afterwards they may drift (optimisation) or move together with it (loop closure).
    """

    def __init__(self, config: VoxelConfig, feature_width: int, device: torch.device = CPU) -> None:
        self.config, self.device = config, device
        self.size = config.size
        """Edge of a voxel, map units."""
        none = torch.zeros(0, dtype=torch.int64, device=device)
        self._group, self._slot = GrowingRows(none), GrowingRows(none)
        self._table = GrowingRows(none.new_zeros(0, config.capacity))
        self._fill, self._voxel = GrowingRows(none), GrowingRows(none)
        self._features = GrowingRows(torch.zeros(0, feature_width, device=device))
        self._groups_of: dict[int, list[int]] = {}
        """Voxel -> its groups, oldest first."""

    def __len__(self) -> int:
        """Number of groups G, those that lost all their Gaussians included."""
        return len(self.fill)

    @property
    def group(self) -> Tensor:
        """[N] group of each Gaussian."""
        return self._group.rows

    @property
    def slot(self) -> Tensor:
        """[N] its place in that group."""
        return self._slot.rows

    @property
    def table(self) -> Tensor:
        """[G, K] row of the Gaussian in each slot; -1 where the slot is free."""
        return self._table.rows

    @property
    def fill(self) -> Tensor:
        """[G] Gaussians in each group, 0 ... K."""
        return self._fill.rows

    @property
    def voxel(self) -> Tensor:
        """[G] voxel of each group, as :meth:`voxel_of` numbers them."""
        return self._voxel.rows

    @property
    def features(self) -> Tensor:
        """[G, F] global feature of each group; an optimiser may change it in place."""
        return self._features.rows

    def voxel_of(
        self,
        means: Tensor,  # [M, 3] map units
    ) -> Tensor:
        """[M] int64 number of the voxel each point lies in; what is not a number counts as 0."""
        cell = torch.floor(means.detach().double().nan_to_num() / self.size)
        x, y, z = cell.clamp(-REACH, REACH - 1).long().add(REACH).unbind(1)
        return (x * (2 * REACH) + y) * (2 * REACH) + z

    def insert(
        self,
        means: Tensor,  # [M, 3] of the Gaussians appended to the map
    ) -> int:
        """Place new Gaussians, numbered on from the last; returns how many groups were opened.

        New groups come after the old ones, with features of zero. Cost grows with M.
        """
        first, count = len(self.group), len(means)
        nowhere = torch.full((count,), EMPTY, dtype=torch.int64, device=self.device)
        self._group.extend(nowhere)
        self._slot.extend(nowhere)
        rows = torch.arange(first, first + count, device=self.device)
        return self._place(rows, means, None)

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False and renumber the others.

        Groups stay, emptied ones too: what is inserted there again finds their feature.
        """
        self._take_out(torch.nonzero(~mask)[:, 0])
        number = torch.cat([torch.cumsum(mask, 0) - 1, self.group.new_full((1,), EMPTY)])
        self.table.copy_(number[self.table])  # EMPTY points at the last number, EMPTY itself
        self._group.keep(mask)
        self._slot.keep(mask)

    def move(
        self,
        rows: Tensor,  # [M] int64, each once
        means: Tensor,  # [N, 3] of all Gaussians, after the move
    ) -> int:
        """Follow Gaussians that were moved (loop closure); returns how many groups were opened.

        A group that is still one neighbourhood, its Gaussians moved by similarities that agree,
        stays together with its feature and is only entered under its new voxel. From a group that
        was torn apart the moved Gaussians are placed anew, in groups that start with the feature
        they had. Cost grows with the groups touched.
        """
        touched, which = torch.unique(self.group[rows], return_inverse=True)
        taken = (self.table[touched] != EMPTY)[..., None]
        points = means.detach()[self.table[touched].clamp_min(0)].double()
        low = torch.where(taken, points, torch.inf).amin(1)
        high = torch.where(taken, points, -torch.inf).amax(1)
        whole = ((high - low) <= WHOLE * self.size).all(1)
        self._enter(touched[whole], self.voxel_of((low + high)[whole] / 2))
        torn = rows[~whole[which]]
        parents = self.group[torn]
        self._take_out(torn)
        return self._place(torn, means[torn], parents)

    def compact(self) -> Tensor:
        """[G] bool: the groups that were kept; drops the empty ones when they are many."""
        taken = self.fill > 0
        if int((~taken).sum()) <= MAX_EMPTY_SHARE * len(self):
            return torch.ones(len(self), dtype=torch.bool, device=self.device)
        number = torch.cumsum(taken, 0) - 1
        self.group.copy_(number[self.group])
        for rows in (self._table, self._fill, self._voxel, self._features):
            rows.keep(taken)
        self._groups_of.clear()
        for group, voxel in enumerate(groups_out(self.voxel)):
            self._groups_of.setdefault(voxel, []).append(group)
        return taken

    def order(self) -> Tensor:
        """[G] groups voxel by voxel, in the order in which each voxel's are filled."""
        listed = [group for groups in self._groups_of.values() for group in groups]
        return groups_in(listed, self.device)

    def restore(
        self,
        group: Tensor,  # [N]
        slot: Tensor,  # [N]
        table: Tensor,  # [G, K]
        fill: Tensor,  # [G]
        voxel: Tensor,  # [G]
        features: Tensor,  # [G, F]
        order: Tensor,  # [G]
    ) -> None:
        """Restore the state that gave these tensors."""
        self._group, self._slot = GrowingRows(group), GrowingRows(slot)
        self._table, self._fill = GrowingRows(table), GrowingRows(fill)
        self._voxel, self._features = GrowingRows(voxel), GrowingRows(features)
        self._groups_of = {}
        voxels = groups_out(voxel)
        for number in groups_out(order):
            self._groups_of.setdefault(voxels[number], []).append(number)

    def _place(
        self,
        rows: Tensor,  # [M] int64, in no group
        means: Tensor,  # [M, 3]
        parents: Tensor | None,  # [M] groups whose feature a new group takes over; None: zeros
    ) -> int:
        """Fill the groups of each voxel, oldest first, then open new ones."""
        keys, order = torch.sort(self.voxel_of(means), stable=True)
        rows = rows[order]
        voxels, counts = torch.unique_consecutive(keys, return_counts=True)
        old = [self._groups_of.get(voxel, []) for voxel in groups_out(voxels)]
        groups = groups_in([group for ids in old for group in ids], self.device)
        place = torch.arange(len(voxels), device=self.device)
        owner = place.repeat_interleave(groups_in([len(ids) for ids in old], self.device))
        room = self.config.capacity - self.fill[groups]
        missing = counts - torch.zeros_like(counts).index_add_(0, owner, room)
        capacity = self.config.capacity
        opened = (missing.clamp_min(0) + capacity - 1).div(capacity, rounding_mode="floor")
        new_owner = place.repeat_interleave(opened)
        groups = torch.cat([groups, self._open(voxels[new_owner])])
        # All groups of a voxel side by side, and how many of its rows each of them takes.
        owner, side_by_side = torch.sort(torch.cat([owner, new_owner]), stable=True)
        groups = groups[side_by_side]
        before = _exclusive_sum(capacity - self.fill[groups])
        first = torch.searchsorted(owner, place)
        before -= before[first][owner]
        taken = torch.minimum((counts[owner] - before).clamp_min(0), capacity - self.fill[groups])
        self._fill_slots(rows, groups, taken)
        if parents is not None:
            fresh = groups >= len(self) - len(new_owner)
            heirs = parents[order][_exclusive_sum(taken)[fresh]]
            self.features[groups[fresh]] = self.features[heirs]
        return len(new_owner)

    def _fill_slots(
        self,
        rows: Tensor,  # [M]
        groups: Tensor,  # [B]
        taken: Tensor,  # [B] rows each group takes, in order; M in all
    ) -> None:
        group = groups.repeat_interleave(taken)
        slot = torch.arange(len(rows), device=self.device)
        slot -= _exclusive_sum(taken).repeat_interleave(taken)
        slot += self.fill[group]
        self.table[group, slot] = rows
        self.group[rows], self.slot[rows] = group, slot
        self.fill[groups] += taken

    def _open(
        self,
        voxels: Tensor,  # [B] int64
    ) -> Tensor:
        """[B] numbers of new, empty groups."""
        first, count = len(self), len(voxels)
        self._table.extend(self.table.new_full((count, self.config.capacity), EMPTY))
        self._fill.extend(self.fill.new_zeros(count))
        self._voxel.extend(voxels)
        self._features.extend(self.features.new_zeros(count, self.features.shape[1]))
        for group, voxel in enumerate(groups_out(voxels), first):
            self._groups_of.setdefault(voxel, []).append(group)
        return torch.arange(first, first + count, device=self.device)

    def _enter(
        self,
        groups: Tensor,  # [B]
        voxels: Tensor,  # [B] where they are now
    ) -> None:
        changed = self.voxel[groups] != voxels
        groups, voxels = groups[changed], voxels[changed]
        old = self.voxel[groups]
        self.voxel[groups] = voxels
        for group, was, now in zip(*map(groups_out, (groups, old, voxels)), strict=True):
            self._groups_of[was].remove(group)
            if not self._groups_of[was]:
                del self._groups_of[was]
            self._groups_of.setdefault(now, []).append(group)

    def _take_out(
        self,
        rows: Tensor,  # [M]
    ) -> None:
        """Free the slots of these Gaussians; those behind them in the group move up."""
        touched = torch.unique(self.group[rows])
        self.table[self.group[rows], self.slot[rows]] = EMPTY
        self.group[rows] = self.slot[rows] = EMPTY
        table = self.table[touched]
        table = table.gather(1, torch.argsort((table == EMPTY).int(), dim=1, stable=True))
        self.table[touched] = table
        group, slot = torch.nonzero(table != EMPTY, as_tuple=True)
        self.slot[table[group, slot]] = slot
        self.fill[touched] = (table != EMPTY).sum(1)


def _exclusive_sum(
    counts: Tensor,  # [M] int64
) -> Tensor:
    """[M] sum of all counts before each."""
    return torch.cumsum(counts, 0) - counts


# --------------------------------------------------------------------------------------------------
# Tensors whose rows come and go while the map grows.


class GrowingRows:
    """A tensor that takes rows at its end, at a cost that grows with the new rows alone."""

    def __init__(
        self,
        rows: Tensor,  # [N, ...]
    ) -> None:
        self._buffer, self._count = rows.clone(), len(rows)

    @property
    def rows(self) -> Tensor:
        """[N, ...] contiguous; the same memory until the next ``extend`` or ``keep``."""
        return self._buffer[: self._count]

    def extend(
        self,
        new: Tensor,  # [M, ...]
    ) -> None:
        """Append rows; the buffer doubles when it is full."""
        count = self._count + len(new)
        if count > len(self._buffer):
            larger = self._buffer.new_empty(2 * count, *self._buffer.shape[1:])
            larger[: self._count] = self.rows
            self._buffer = larger
        self._buffer[self._count : count] = new
        self._count = count

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the rows where ``mask`` is False."""
        self._buffer = self.rows[mask]
        self._count = len(self._buffer)
