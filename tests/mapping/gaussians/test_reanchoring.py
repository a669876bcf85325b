"""The map follows its keyframes: what was seen before a correction is seen after it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.geometry.similarity import Sim3, rotation_from_quaternion
from aquaflow.mapping.gaussians import GaussianMap, move_gaussians, move_views, quaternion_product
from aquaflow.mapping.mapper import Mapper
from tests.mapping.mapping_scenes import (
    cloud,
    flat_pointmap,
    floor,
    path,
    picture,
    pose,
    renderer,
    settings,
    view_of,
)

S = Sim3(pose((0, 0, 0), (0.2, -0.4, 0.9)).R, np.array([0.7, -0.3, 1.1]), 1.7)
angles = st.floats(-3.0, 3.0)


def owned(numbers: list[int]) -> GaussianMap:
    """A cloud (no two are equally deep) whose Gaussians belong to keyframes in turn."""
    gaussians = cloud()
    owners = torch.tensor(numbers).repeat(len(gaussians) // len(numbers) + 1)
    gaussians.keyframes = owners[: len(gaussians)]
    return gaussians


def test_a_map_that_moves_with_its_camera_looks_the_same() -> None:
    before, after = owned([0, 3]), owned([0, 3])
    view = view_of(picture(before, path(1)[0]))
    drawn = picture(before, path(1)[0])
    assert len(move_gaussians(after, {0: S, 3: S})) == len(after)
    move_views([view], {0: S})
    moved = picture(after, view.T_wc)
    assert np.abs(moved.astype(int) - drawn.astype(int)).max() <= 2


def test_only_the_moved_keyframes_gaussians_move() -> None:
    gaussians, untouched = owned([0, 1, 2]), owned([0, 1, 2])
    mine = torch.nonzero(gaussians.keyframes == 1)[:, 0]
    assert torch.equal(move_gaussians(gaussians, {1: S}), mine)
    rest = gaussians.keyframes != 1
    for name in GaussianMap.NAMES:
        assert torch.equal(gaussians.parameters[name][rest], untouched.parameters[name][rest])
    assert not torch.equal(gaussians.means, untouched.means)


def test_there_and_back_is_where_it_was() -> None:
    gaussians, before = owned([4]), owned([4])
    move_gaussians(gaussians, {4: S})
    move_gaussians(gaussians, {4: S.inverse()})
    for name in ("means", "log_scales"):
        assert torch.allclose(gaussians.parameters[name], before.parameters[name], atol=1e-5)
    turn = (gaussians.parameters["quats"] * before.parameters["quats"]).sum(1).abs()
    assert torch.allclose(turn, torch.ones_like(turn), atol=1e-6)


def test_moving_nothing_costs_nothing_and_changes_nothing() -> None:
    gaussians = owned([0])
    assert len(move_gaussians(gaussians, {})) == 0
    assert len(move_gaussians(gaussians, {7: S})) == 0
    assert len(move_gaussians(GaussianMap(), {0: S})) == 0


@given(st.tuples(angles, angles, angles), st.tuples(angles, angles, angles))
def test_the_quaternion_product_is_the_product_of_rotations(
    first: tuple[float, float, float], second: tuple[float, float, float]
) -> None:
    a, b = pose((0, 0, 0), first), pose((0, 0, 0), second)
    q = quaternion_product(
        torch.from_numpy(a.quaternion)[None], torch.from_numpy(b.quaternion)[None]
    )
    assert np.allclose(rotation_from_quaternion(q.numpy()[0]), a.R @ b.R, atol=1e-12)


def test_depths_of_a_scaled_keyframe_insert_at_the_scaled_place() -> None:
    plain, scaled = Mapper(settings(), renderer(), 0), Mapper(settings(), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    plain.insert(view, flat_pointmap())
    larger = view_of(picture(floor(), path(1)[0]))
    larger.T_wc = Sim3(view.T_wc.R, view.T_wc.t, 2.0)
    scaled.insert(larger, flat_pointmap())
    assert torch.allclose(scaled.gaussians.means, 2.0 * plain.gaussians.means, atol=1e-5)
    assert torch.allclose(scaled.gaussians.scales, 2.0 * plain.gaussians.scales, rtol=1e-5)


def test_the_depth_loss_of_a_view_is_the_same_before_and_after_its_keyframe_moved() -> None:
    mapper = Mapper(settings(medium={"enabled": False}), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    mapper.add_view(view)
    mapper.insert(view, flat_pointmap())

    def depth_term() -> float:
        shown = mapper.show(view)
        assert view.inverse_range is not None
        z, expected = shown.z, view.inverse_range / view.T_wc.scale
        solid = (shown.alpha > 0.9) & (expected > 0.0)
        return float((1.0 / z[solid] / expected[solid] - 1.0).abs().mean())

    before = depth_term()
    mapper.move({view.keyframe: S})
    assert depth_term() == pytest.approx(before, abs=2e-3)  # left unscaled: 0.4


def test_an_absorbed_sub_map_is_optimised_on_with_its_views() -> None:
    first, second = (Mapper(settings(), renderer(), seed) for seed in (0, 1))
    for mapper, T_wc in zip((first, second), path(2), strict=True):
        view = view_of(picture(floor(), T_wc), T_wc)
        mapper.add_view(view)
        mapper.insert(view, flat_pointmap())
    count = len(first.gaussians) + len(second.gaussians)
    first.absorb(second)
    assert len(first.gaussians) == count
    assert len(first.views) == 2
    first.optimise(3)
    assert first.steps == 3


def test_views_move_as_each_would_alone_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    poses = [pose(tuple(rng.normal(size=3)), tuple(rng.normal(size=3))) for _ in range(40)]
    views = [view_of(T_wc) for T_wc in poses]
    moves = {}
    for i, view in enumerate(views):
        view.frame_index, view.keyframe = i, i // 3
        moves[view.keyframe] = Sim3.exp(0.02 * rng.normal(size=7))
    alone = [moves[view.keyframe] @ view.T_wc for view in views]
    move_views(views, moves)
    for view, expected in zip(views, alone, strict=True):
        assert (view.T_wc.matrix == expected.matrix).all()
        assert view.T_wc.scale == expected.scale
