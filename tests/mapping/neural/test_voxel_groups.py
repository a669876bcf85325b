"""Voxel groups: every Gaussian in one slot, whatever was inserted, pruned and moved."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from aquaflow.config import VoxelConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from tests.mapping.mapping_scenes import pose

SIZE = 0.1


pytestmark = pytest.mark.usefixtures("one_thread")


def groups_of(means: Tensor, capacity: int = 4, width: int = 1) -> VoxelGroups:
    groups = VoxelGroups(VoxelConfig(size=SIZE, capacity=capacity), width)
    groups.insert(means)
    return groups


def centred(*cells: tuple[int, int, int]) -> Tensor:
    """Points in the middle of voxels."""
    return (torch.tensor(cells, dtype=torch.float32) + 0.5) * SIZE


def check_invariants(groups: VoxelGroups) -> None:
    """Each row in exactly one slot, slots without holes, table and rows agree, lookup whole."""
    count, capacity = len(groups.group), groups.config.capacity
    taken = groups.table != EMPTY
    assert torch.equal(torch.sort(groups.table[taken]).values, torch.arange(count))
    assert torch.equal(groups.table[groups.group, groups.slot], torch.arange(count))
    assert torch.equal(taken, torch.arange(capacity) < groups.fill[:, None])
    assert len(groups.features) == len(groups.voxel) == len(groups)
    listed = sorted((g, voxel) for voxel, ids in groups._groups_of.items() for g in ids)
    assert listed == list(enumerate(groups.voxel.tolist()))


def similarity(seed: int, angle: float, scale: float) -> Sim3:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = tuple(angle * axis / np.linalg.norm(axis))
    return Sim3(pose((0, 0, 0), turn).R, rng.normal(size=3), scale)


class Follower:
    """A small map beside the groups: what a mapper would hold, and what each row must find."""

    def __init__(self, seed: int, capacity: int, spread: float) -> None:
        self.random = torch.Generator().manual_seed(seed)
        self.spread = spread
        self.means = torch.zeros(0, 3)
        self.owner = torch.zeros(0, dtype=torch.int64)
        self.groups = VoxelGroups(VoxelConfig(size=SIZE, capacity=capacity), 1)
        self.name = torch.zeros(0)
        """[G] what was written into each group's feature when it was opened."""

    def insert(self, count: int, keyframe: int) -> None:
        first = len(self.means)
        new = torch.randn(count, 3, generator=self.random) * self.spread
        self.means = torch.cat([self.means, new])
        self.owner = torch.cat([self.owner, torch.full((count,), keyframe)])
        before = len(self.groups)
        assert self.groups.insert(new) == len(self.groups) - before
        self.name_new(before)
        self.check_voxels(torch.arange(first, first + count))

    def name_new(self, before: int) -> None:
        new = torch.arange(len(self.groups) - before, dtype=torch.float32) + 1.0
        self.name = torch.cat([self.name, new + (self.name.max() if before else 0.0)])
        self.groups.features[before:, 0] = self.name[before:]

    def check_voxels(self, rows: Tensor) -> None:
        wanted = self.groups.voxel_of(self.means[rows])
        assert torch.equal(self.groups.voxel[self.groups.group[rows]], wanted)

    def prune(self, share: float) -> None:
        mask = torch.rand(len(self.means), generator=self.random) >= share
        found = self.groups.features[self.groups.group[mask]]
        self.means, self.owner = self.means[mask], self.owner[mask]
        self.groups.keep(mask)
        assert torch.equal(self.groups.features[self.groups.group], found)

    def move(self, keyframe: int, S: Sim3) -> None:
        rows = torch.nonzero(self.owner == keyframe)[:, 0]
        turned = self.means[rows].double() @ torch.from_numpy(S.scale * S.R).T
        self.means[rows] = (turned + torch.from_numpy(S.t)).float()
        found = self.groups.features[self.groups.group]
        groups, before = self.groups.group.clone(), len(self.groups)
        opened = self.groups.move(rows, self.means)
        assert opened == len(self.groups) - before
        stayed = self.groups.group == groups
        assert torch.equal(self.groups.features[self.groups.group[stayed]], found[stayed])
        still = torch.ones(len(self.means), dtype=torch.bool)
        still[rows] = False
        assert bool(stayed[still].all())
        self.check_voxels(torch.nonzero(~stayed)[:, 0])
        self.name_new(before)

    def compact(self) -> None:
        found = self.groups.features[self.groups.group]
        kept = self.groups.compact()
        self.name = self.name[kept]
        assert torch.equal(self.groups.features[:, 0], self.name)
        assert torch.equal(self.groups.features[self.groups.group], found)


operations = st.lists(
    st.tuples(st.sampled_from(["insert", "prune", "move", "compact"]), st.integers(0, 60)),
    min_size=1,
    max_size=12,
)


@settings(deadline=None, max_examples=60)
@given(operations, st.integers(0, 99), st.sampled_from([1, 3, 32]), st.sampled_from([0.05, 0.4]))
def test_the_invariants_hold_after_any_operations(
    todo: list[tuple[str, int]], seed: int, capacity: int, spread: float
) -> None:
    scene = Follower(seed, capacity, spread)
    for step, (name, amount) in enumerate(todo):
        match name:
            case "insert":
                scene.insert(amount, keyframe=step % 3)
            case "prune":
                scene.prune(amount / 60.0)
            case "move":
                scene.move(amount % 3, similarity(step, amount / 20.0, 0.5 + amount / 40.0))
            case _:
                scene.compact()
        check_invariants(scene.groups)


def work(scene: Follower, count: int, rounds: int) -> None:
    """``rounds`` times: insert, prune and move a little, at about ``count`` Gaussians."""
    for first in range(0, count, 2000):
        scene.insert(min(2000, count - first), keyframe=first // 2000)
    for step in range(rounds):
        keyframe = count + step
        scene.insert(60, keyframe)
        scene.move(keyframe, similarity(step, 0.02, 1.01))
        scene.prune(60 / len(scene.means))
        scene.compact()
    check_invariants(scene.groups)


def test_three_hundred_operations_on_a_map_hold_the_invariants() -> None:
    work(Follower(0, 32, 0.5), count=5_000, rounds=100)


@pytest.mark.slow
def test_ten_thousand_operations_on_two_hundred_thousand_gaussians_hold_the_invariants() -> None:
    work(Follower(0, 32, 0.7), count=200_000, rounds=3_334)


def test_gaussians_of_a_voxel_share_a_group_and_others_do_not() -> None:
    groups = groups_of(centred((0, 0, 0), (-1, 0, 0), (0, 0, 0), (0, 1, 0)))
    first, other, again, third = groups.group.tolist()
    assert first == again
    assert len({first, other, third}) == 3


def test_a_voxel_that_overflows_opens_a_further_group_and_fills_holes_first() -> None:
    groups = groups_of(centred(*[(2, 3, 4)] * 6), capacity=4)
    assert groups.fill.tolist() == [4, 2]
    groups.keep(torch.tensor([True, False, True, True, True, True]))
    assert groups.insert(centred((2, 3, 4), (2, 3, 4))) == 0
    assert groups.fill.tolist() == [4, 3]
    check_invariants(groups)


def test_a_new_group_starts_with_a_feature_of_zero_after_the_old_ones() -> None:
    groups = groups_of(centred((0, 0, 0)), width=3)
    groups.features.fill_(7.0)
    assert groups.insert(centred((5, 5, 5), (0, 0, 0))) == 1
    assert groups.features.tolist() == [[7.0] * 3, [0.0] * 3]
    assert groups.group.tolist() == [0, 1, 0]


def test_what_is_inserted_where_all_was_pruned_finds_the_feature_of_the_place() -> None:
    groups = groups_of(centred((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)))
    groups.features[0] = 5.0
    groups.keep(torch.tensor([False, True, True, True]))
    assert bool(groups.compact().all())  # one empty group in four is not many
    assert groups.insert(centred((0, 0, 0))) == 0
    assert groups.features[groups.group[-1]] == 5.0


def test_empty_groups_are_dropped_when_they_are_many() -> None:
    groups = groups_of(centred((0, 0, 0), (1, 0, 0), (2, 0, 0)))
    groups.features[:, 0] = torch.tensor([1.0, 2.0, 3.0])
    groups.keep(torch.tensor([False, True, False]))
    assert groups.compact().tolist() == [False, True, False]
    assert groups.features.tolist() == [[2.0]]
    check_invariants(groups)


def test_a_group_that_moves_as_a_whole_stays_together_under_its_new_voxel() -> None:
    means = centred((0, 0, 0)) + torch.tensor([[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0]])
    groups = groups_of(means)
    groups.features.fill_(3.0)
    S = similarity(0, math.pi / 4, 1.5)
    moved = (S.scale * means.double() @ torch.from_numpy(S.R).T + torch.from_numpy(S.t)).float()
    assert groups.move(torch.arange(2), moved) == 0
    middle = moved.mean(0, keepdim=True)
    assert torch.equal(groups.voxel, groups.voxel_of(middle))
    assert groups.insert(middle) == 0  # the new voxel knows the group
    assert groups.insert(centred((0, 0, 0))) == 1  # the old one does not
    check_invariants(groups)


def test_a_group_that_is_torn_apart_leaves_its_feature_to_the_part_that_moved() -> None:
    means = centred((0, 0, 0), (0, 0, 0), (0, 0, 0))
    groups = groups_of(means)
    groups.features.fill_(3.0)
    means[1:, 0] += 2.0
    assert groups.move(torch.tensor([1, 2]), means) == 1
    assert groups.group.tolist() == [0, 1, 1]
    assert groups.features.tolist() == [[3.0], [3.0]]
    check_invariants(groups)


def test_a_group_stretched_beyond_a_neighbourhood_is_placed_anew() -> None:
    means = centred((0, 0, 0)) + torch.tensor([[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0]])
    groups = groups_of(means)
    assert groups.move(torch.arange(2), 10.0 * means) == 2
    assert groups.fill.tolist() == [0, 1, 1]
    check_invariants(groups)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_a_place_that_is_no_number_or_out_of_reach_costs_nothing_else(bad: float) -> None:
    means = torch.cat([centred((0, 0, 0), (1, 1, 1)), torch.full((1, 3), bad)])
    groups = groups_of(means)
    check_invariants(groups)
    means[0] = bad
    groups.move(torch.tensor([0]), means)
    check_invariants(groups)


def test_nothing_in_nothing_out() -> None:
    groups = groups_of(torch.zeros(0, 3))
    assert len(groups) == 0
    groups.keep(torch.zeros(0, dtype=torch.bool))
    assert groups.move(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3)) == 0
    assert groups.compact().tolist() == []
    check_invariants(groups)
