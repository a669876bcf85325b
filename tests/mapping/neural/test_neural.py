"""Neural Gaussians in the mapper: they learn, follow the map, and cost what they touch only."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.config import MappingConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.neural.decoder import DECODED
from aquaflow.mapping.neural.neural import NeuralGaussians
from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from tests.mapping.mapping_scenes import (
    copied,
    error,
    filmed,
    flat_pointmap,
    floor,
    grown,
    path,
    renderer,
    same,
    settings,
)

pytestmark = pytest.mark.usefixtures("one_thread")

S = Sim3(so3_exp(np.array([0.1, -0.4, 0.2])), np.array([0.5, -1.0, 0.3]), 1.5)


def neural(**decoder: Any) -> MappingConfig:
    return settings(
        decoder={"enabled": True, "width": 8, "views_per_trunk": 4, **decoder},
        optimiser={"refine_steps": 24, "prune_every": 10},
    )


def decoder_of(mapper: Mapper) -> NeuralGaussians:
    assert mapper.neural is not None
    return mapper.neural


def is_whole(mapper: Mapper) -> bool:
    """Every Gaussian has its place in a group, and every tensor its rows."""
    decoder, count = decoder_of(mapper), len(mapper.gaussians)
    groups = decoder.groups
    placed = bool((groups.table[groups.group, groups.slot] == torch.arange(count)).all())
    features = decoder.optimisers.local.params["local"] is mapper.gaussians.local_features
    rows = len(mapper.gaussians.local_features) == count == len(decoder.optimisers.local.steps)
    shared = len(groups) == len(decoder.optimisers.shared.steps)
    return placed and features and rows and shared and int((groups.table != EMPTY).sum()) == count


def test_a_new_map_looks_as_it_would_without_a_decoder() -> None:
    plain, decoded = grown(settings()), grown(neural())
    assert torch.equal(plain.show(plain.views[1]).image, decoded.show(decoded.views[1]).image)


@pytest.mark.parametrize("optimise_initial", [True, False])
@pytest.mark.parametrize("observation", ["after_attention", "before_attention"])
def test_steps_explain_the_views_better(optimise_initial: bool, observation: str) -> None:
    mapper = grown(neural(optimise_initial=optimise_initial, observation=observation))
    before, initial = error(mapper), copied(mapper)
    mapper.optimise(24)
    assert error(mapper) < 0.9 * before
    assert bool(mapper.gaussians.local_features.any())
    moved = {name for name in DECODED if not torch.equal(initial[name], copied(mapper)[name])}
    assert moved == (set(DECODED) if optimise_initial else set())


def test_the_same_seed_gives_the_same_map_bit_for_bit() -> None:
    one, two = (grown(neural()) for _ in range(2))
    for mapper in (one, two):
        mapper.optimise(10)
        mapper.refine()
    assert same(copied(one), copied(two))
    assert torch.equal(one.gaussians.local_features, two.gaussians.local_features)
    assert torch.equal(one.show(one.views[0]).image, two.show(two.views[0]).image)


def test_a_window_of_views_learns_at_its_end_and_prunings_end_it() -> None:
    mapper = grown(neural(views_per_trunk=4))
    features = mapper.gaussians.local_features
    decoder = decoder_of(mapper)
    mapper.optimise(1)
    ahead = [mapper.views[i] for i in (0, 1, 2)]
    decoder.expect(ahead)
    learned = decoder.optimisers.local.steps.clone()
    for view in ahead:
        mapper.optimiser.step(view, refine_pose=False)
        assert torch.equal(decoder.optimisers.local.steps, learned)
    decoder.settle()
    assert bool((decoder.optimisers.local.steps > learned).any())
    mapper.gaussians.parameters["opacity_logits"][:7] = -8.0
    mapper.refine()
    assert len(mapper.gaussians) <= len(features) - 7
    assert is_whole(mapper)


def test_steps_that_are_left_out_leave_the_window_whole() -> None:
    mapper = grown(neural(views_per_trunk=3))
    decoder, views = decoder_of(mapper), mapper.views
    decoder.expect([views[0], views[1], views[2], views[3]])
    mapper.optimiser.step(views[0], refine_pose=False)
    opened = decoder._window
    mapper.optimiser.step(views[2], refine_pose=False)
    assert decoder._window is opened
    mapper.optimiser.step(views[3], refine_pose=False)
    assert decoder._window is not opened
    assert decoder._window is not None
    assert decoder._window.views == []


def test_groups_and_features_follow_what_the_map_does() -> None:
    mapper = grown(neural())
    assert is_whole(mapper)
    mapper.optimise(8)
    mapper.insert(mapper.views[2], flat_pointmap())
    assert is_whole(mapper)
    looked = mapper.show(mapper.views[0]).image
    mapper.move({0: S})
    assert is_whole(mapper)
    # The decoder is told directions in the world, so a turn of it is not free; it is not much.
    assert float((mapper.show(mapper.views[0]).image - looked).abs().mean()) < 0.02
    keep = torch.arange(len(mapper.gaussians)) % 3 != 0
    mapper.optimiser.keep(keep)
    assert is_whole(mapper)


def test_what_is_inserted_into_a_trained_map_looks_as_it_was_given() -> None:
    mapper = grown(neural())
    mapper.optimise(16)
    decoder, before = decoder_of(mapper), len(mapper.gaussians)
    new = {name: tensor[:5].clone() for name, tensor in mapper.gaussians.parameters.items()}
    mapper.gaussians.extend(new, 0)
    centre = torch.tensor([0.1, 0.0, -0.2])
    decoder.insert(centre, 5)
    baked = decoder.bake_parameters(centre.expand(before + 5, 3))
    for name in DECODED:
        torch.testing.assert_close(baked[name][before:], new[name], rtol=0, atol=1e-5)


def test_a_sub_map_that_is_absorbed_keeps_its_looks() -> None:
    first, second = grown(neural(), seed=0), grown(neural(), seed=1)
    for mapper in (first, second):
        mapper.optimise(16)
    baked = second.scene.bake_parameters(second.views)
    count = len(second.gaussians)
    views = list(second.views)
    first.absorb(second)
    assert is_whole(first)
    assert second.neural is None
    seen = first.scene.neural.bake_parameters(first.scene.nearest_cameras(views)[0])  # type: ignore[union-attr]
    for name in DECODED:
        torch.testing.assert_close(seen[name][-count:], baked[name], rtol=0, atol=1e-4)


def test_looking_again_from_a_view_takes_no_new_pass_until_something_is_learned() -> None:
    mapper = grown(neural())
    mapper.optimise(8)
    passes = 0
    decoder = decoder_of(mapper)
    trunk = decoder.decoder.trunk

    def counted(*inputs: Any) -> Any:
        nonlocal passes
        passes += 1
        return trunk(*inputs)

    decoder.decoder.trunk = counted  # type: ignore[method-assign]
    first = mapper.show(mapper.views[0])
    again = mapper.show(mapper.views[0])
    assert passes == 1
    assert torch.equal(first.image, again.image)
    mapper.optimise(1)
    mapper.show(mapper.views[0])
    assert passes == 3


def test_all_groups_or_those_in_view_give_the_same_picture() -> None:
    pictures = []
    for visible in (True, False):
        mapper = grown(neural(visible_groups=visible))
        pictures.append(mapper.show(mapper.views[0]).image)
        mapper.optimise(4)
        pictures.append(mapper.show(mapper.views[0]).image)
    torch.testing.assert_close(pictures[0], pictures[2])
    torch.testing.assert_close(pictures[1], pictures[3], rtol=0, atol=1e-3)


def test_a_gradient_that_is_no_number_does_not_reach_the_weights() -> None:
    mapper = grown(neural())
    mapper.optimise(8)
    decoder = decoder_of(mapper)
    before = [weight.detach().clone() for weight in decoder.decoder.parameters()]
    view = mapper.views[0]
    decoder.expect([view])
    mapper.optimiser.step(view, refine_pose=False)
    window = decoder._window
    assert window is not None
    assert window.hidden.grad is not None
    window.hidden.grad[0, 0] = math.nan
    decoder.settle()
    assert decoder.optimisers.skipped == 1
    after = decoder.decoder.parameters()
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))
    assert bool(torch.isfinite(mapper.gaussians.local_features).all())


def test_a_held_out_pose_is_found_against_decoded_gaussians() -> None:
    mapper = grown(neural())
    mapper.optimise(8)
    view = filmed(floor(), path(6))[5]
    before = copied(mapper)
    mapper.register(view)
    assert same(before, copied(mapper))


def test_an_empty_map_decodes_to_nothing() -> None:
    mapper = Mapper(neural(), renderer(), 0)
    for view in filmed(floor(), path(2)):
        mapper.add_view(view)
    mapper.optimise(3)
    assert float(mapper.show(mapper.views[0]).alpha.max()) == 0.0


@pytest.mark.parametrize("table", ["_group", "_slot", "_table", "_fill", "_voxel", "_features"])
def test_tables_that_a_failure_left_half_changed_are_made_whole(table: str) -> None:
    mapper = grown(neural())
    mapper.optimise(6)  # the window is open
    decoder = decoder_of(mapper)
    decoder.groups.features.fill_(0.25)
    rows = getattr(decoder.groups, table)
    rows.extend(rows.rows[:2].clone())
    mapper.make_whole()
    assert is_whole(mapper)
    known = 0.25 if table != "_features" else decoder.groups.features.max()
    assert bool((decoder.groups.features == known).any())
    mapper.optimise(8)
    decoder.settle()
    assert is_whole(mapper)


def test_a_whole_map_keeps_its_groups_after_a_failure_elsewhere() -> None:
    mapper = grown(neural())
    groups = decoder_of(mapper).groups
    mapper.make_whole()
    assert decoder_of(mapper).groups is groups


def test_a_sub_map_whose_groups_could_not_be_placed_comes_over_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper, other = grown(neural()), grown(settings())
    count, views = len(mapper.gaussians), len(mapper.views)
    place = VoxelGroups._place

    def failing(groups: VoxelGroups, *arguments: Any) -> int:
        place(groups, *arguments)
        monkeypatch.setattr(VoxelGroups, "_place", place)
        raise RuntimeError("once")

    monkeypatch.setattr(VoxelGroups, "_place", failing)
    with pytest.raises(RuntimeError, match="once"):
        mapper.absorb(other)
    mapper.make_whole()
    assert is_whole(mapper)
    assert len(mapper.gaussians) == count + len(other.gaussians)
    assert len(mapper.views) == views + len(other.views)


def test_before_the_attention_a_pose_that_moves_is_observed_anew() -> None:
    mapper = grown(neural(observation="before_attention"))
    mapper.optimise(8)
    view, decoder = mapper.views[0], decoder_of(mapper)
    first = decoder.seen_from(view, view.viewmat())["raw_colours"].clone()
    moved = view.viewmat()
    moved[2, 3] += 0.4
    there = decoder.seen_from(view, moved)["raw_colours"].clone()
    decoder._looked = None
    assert torch.equal(there, decoder.seen_from(view, moved)["raw_colours"])
    assert not torch.equal(there, first)


def test_before_the_attention_new_gaussians_look_as_they_were_inserted() -> None:
    mapper = grown(neural(observation="before_attention"))
    mapper.optimise(8)
    view = mapper.views[1]
    count = mapper.insert(view, flat_pointmap(1.0))
    assert count > 0
    seen = mapper.scene.seen_from(view, view.viewmat())
    assert seen["quats"][-count:, 0].sub(1.0).abs().max() < 1e-5


def test_voxels_in_metres_count_once_the_unit_is_known() -> None:
    mapper = grown(neural(voxels={"size": 0.05, "size_m": 0.2}))
    mapper.optimise(4)
    decoder = decoder_of(mapper)
    assert decoder.groups.size == 0.05
    groups, features = len(decoder.groups), decoder.groups.features.clone()
    mapper.use_unit(0.5)
    assert decoder.groups.size == pytest.approx(0.4)
    assert len(decoder.groups) < groups
    assert is_whole(mapper)
    known = {tuple(row) for row in features.tolist()}
    assert all(tuple(row) in known for row in decoder.groups.features.tolist())
    same_groups = decoder.groups
    mapper.use_unit(0.52)
    assert decoder.groups is same_groups  # 4 % is no other size
    mapper.optimise(4)
    assert is_whole(mapper)


def test_voxels_in_map_units_stay_when_the_unit_is_known() -> None:
    mapper = grown(neural())
    before = decoder_of(mapper).groups
    mapper.use_unit(3.0)
    assert decoder_of(mapper).groups is before
