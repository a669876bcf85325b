"""What makes a pair hard: bodies, overlays, moving light, snow, blur, and too little light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import pytest
import torch

from aquaflow.lab.training.pair_generator.cameras import TRAINING
from aquaflow.lab.training.pair_generator.conditions import (
    CALM,
    Conditions,
    in_low_light,
    with_bodies,
    with_caustics,
    with_motion_blur,
    with_overlay,
    with_snow,
)
from aquaflow.lab.training.pair_generator.drawing import (
    WindowVariation,
    through_water,
    training_pair,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.water import random_water, turbidity
from aquaflow.lab.training.pairs import Pair, ViewBatch, correspondences

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT, BATCH = 96, 72, 4


@pytest.fixture(scope="module")
def clear() -> Pair:
    return render_pairs(Draw(7), BATCH, WIDTH, HEIGHT, TRAINING, Detail(terrain=64, texture=128))


@pytest.mark.parametrize("effect", [with_bodies, with_overlay])
def test_what_covers_the_scene_is_no_match(
    effect: Callable[[Draw, Pair], Pair], clear: Pair
) -> None:
    pair = effect(Draw(1), clear)
    for new, old in ((pair.a, clear.a), (pair.b, clear.b)):
        covered = old.valid & ~new.valid
        assert bool(covered.flatten(1).any(1).all())
        changed = (new.image != old.image).any(1)
        assert not bool((changed & new.valid).any())
    found = correspondences(pair)
    assert not bool((found.visible & ~pair.a.valid).any())
    rows, columns = found.pixels.nan_to_num().floor().long().flip(-1).unbind(-1)
    rows, columns = rows.clamp(0, HEIGHT - 1), columns.clamp(0, WIDTH - 1)
    there = pair.b.valid[torch.arange(BATCH)[:, None, None], rows, columns]
    assert not bool((found.visible & ~there).any())


def test_an_overlay_stays_where_it_is(clear: Pair) -> None:
    pair = with_overlay(Draw(2), clear)
    moved = [(view.image - old.image).abs().amax(1) > 0.2 for view, old in _views(pair, clear)]
    common = (moved[0] & moved[1]).sum() / (moved[0] | moved[1]).sum()
    assert float(common) > 0.6


def test_bodies_move_between_the_views(clear: Pair) -> None:
    pair = with_bodies(Draw(3), clear)
    covered = [old.valid & ~view.valid for view, old in _views(pair, clear)]
    assert not torch.equal(*covered)


def test_covered_pixels_have_no_depth_after_the_sensor(clear: Pair) -> None:
    pair = through_water(Draw(4), clear, Conditions(bodies=1.0, overlay=1.0))
    for new, old in _views(pair, clear):
        covered = old.valid & ~new.valid
        assert bool(covered.any())
        assert float(new.depth[covered].abs().max()) == 0.0
        assert torch.equal(new.depth[new.valid], old.depth[new.valid])


def test_caustics_have_moved_on_and_change_no_geometry(clear: Pair) -> None:
    same = Pair(clear.a, clear.a)
    pair = with_caustics(Draw(5), same)
    assert not torch.allclose(pair.a.image, pair.b.image)
    assert torch.equal(pair.a.depth, clear.a.depth)
    assert torch.equal(pair.b.valid, clear.a.valid)


def test_snow_only_adds_light_and_differs_between_pictures() -> None:
    radiance = torch.full((6, 3, HEIGHT, WIDTH), 0.3)
    snowy = with_snow(Draw(6), radiance)
    added = snowy - radiance
    assert float(added.min()) >= 0.0
    assert bool((added.flatten(1).amax(1) > 0.01).all())
    assert not torch.equal(added[0], added[1])


def test_motion_blur_keeps_the_light_and_the_place_of_a_point() -> None:
    point = torch.zeros(8, 3, 41, 41)
    point[:, :, 20, 20] = 1.0
    blurred = with_motion_blur(Draw(7), point)
    axis = torch.arange(41.0)
    assert torch.allclose(blurred.sum(dim=(2, 3)), torch.ones(8, 3), atol=1e-4)
    assert torch.allclose(blurred.sum(2) @ axis, torch.full((8, 3), 20.0), atol=1e-2)
    assert torch.allclose(blurred.sum(3) @ axis, torch.full((8, 3), 20.0), atol=1e-2)
    assert float(blurred.amax()) < 1.0


def test_low_light_is_dim_and_in_the_camera_s_levels() -> None:
    image = torch.rand(4, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    dim = in_low_light(Draw(8), image)
    assert bool((dim.mean(dim=(1, 2, 3)) < 0.6 * image.mean(dim=(1, 2, 3))).all())
    assert torch.allclose((255.0 * dim).round(), 255.0 * dim, atol=1e-3)


def test_turbid_water_hides_more(clear: Pair) -> None:
    water = random_water(Draw(9), torch.full((BATCH,), 2.0))
    factor = turbidity(Draw(9), 1.0, BATCH)
    assert float(factor.min()) > 1.0
    direct = torch.exp(-2.0 * water.beta_a)
    assert bool((torch.exp(-2.0 * water.denser(factor).beta_a) < direct).all())
    assert torch.equal(turbidity(Draw(9), 0.0, BATCH), torch.ones(BATCH))


def test_calm_conditions_change_and_draw_nothing(clear: Pair) -> None:
    assert torch.equal(
        through_water(Draw(10), clear).a.image, through_water(Draw(10), clear, CALM).a.image
    )
    draw = Draw(11)
    assert CALM.before_water(draw, clear) is clear
    assert torch.equal(draw.uniform(3), Draw(11).uniform(3))


def test_conditions_are_scaled_together() -> None:
    half = Conditions().scale(0.5)
    for field in fields(Conditions):
        assert getattr(half, field.name) == pytest.approx(0.5 * getattr(Conditions(), field.name))


def test_every_condition_at_once_gives_pictures_and_matches(clear: Pair) -> None:
    looks = WindowVariation(width=48, height=32)
    pair = training_pair(Draw(12), clear, looks, Conditions().scale(10.0))
    for view in (pair.a, pair.b):
        assert bool(torch.isfinite(view.image).all())
        assert float(view.image.min()) >= 0.0
        assert float(view.image.max()) <= 1.0
    assert bool(correspondences(pair).visible.any())


def _views(pair: Pair, clear: Pair) -> tuple[tuple[ViewBatch, ViewBatch], ...]:
    """Each view with what it was made of."""
    return ((pair.a, clear.a), (pair.b, clear.b))
