"""Generated scenes: geometry is exact, pictures do not flicker, the same seed gives the same."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.cameras import (
    TRAINING,
    first_camera,
    intrinsics,
    second_camera,
)
from aquaflow.lab.training.pair_generator.drawing import turned_view
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import (
    first_hits,
    median_depth,
    render_pairs,
    render_view,
)
from aquaflow.lab.training.pair_generator.scene import Detail, SceneBatch, random_scenes, rotation
from aquaflow.lab.training.pairs import Pair, ViewBatch, correspondences, seen_from

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT, BATCH = 64, 48, 2
COARSE = Detail(terrain=64, texture=128)


def unlit(scene: SceneBatch) -> SceneBatch:
    """Without what changes from picture to picture: lamps and caustics."""
    nothing = torch.zeros(BATCH)
    return replace(scene, light=replace(scene.light, lamps=nothing, caustics=nothing))


@pytest.fixture(scope="module")
def scene() -> SceneBatch:
    return unlit(random_scenes(Draw(3), BATCH, COARSE))


@pytest.fixture(scope="module")
def pair(scene: SceneBatch) -> Pair:
    draw = Draw(4)
    K = intrinsics(draw, BATCH, WIDTH, HEIGHT)
    T_a = first_camera(draw, scene.terrain)
    a = render_view(draw, scene, K, T_a, WIDTH, HEIGHT)
    T_b = second_camera(draw, scene.terrain, T_a, median_depth(a), TRAINING)
    return Pair(a, render_view(draw, scene, K, T_b, WIDTH, HEIGHT))


def looked_up(
    field: Tensor,  # [B, C, H, W]
    pixels: Tensor,  # [B, H, W, 2]
) -> Tensor:
    grid = pixels / torch.tensor([WIDTH, HEIGHT]) * 2.0 - 1.0
    return F.grid_sample(field, grid, align_corners=False)


def test_what_is_hit_lies_on_the_floor_or_on_a_body(scene: SceneBatch, pair: Pair) -> None:
    view = pair.a
    rays = view.rays(HEIGHT, WIDTH).flatten(1, 2) @ view.T_wc[:, :3, :3].mT
    centre = view.T_wc[:, :3, 3]
    hits = first_hits(scene, centre, rays)
    points = centre[:, None] + hits.depth[..., None] * rays
    on_floor = (points[..., 2] - scene.terrain.height(points[..., :2])).abs() < 0.01
    solids = scene.solids
    inside = (points[:, None] - solids.centre[:, :, None]) @ solids.R / solids.half[:, :, None]
    of_body = torch.where(
        solids.box[..., None], inside.abs().amax(-1), torch.linalg.vector_norm(inside, dim=-1)
    )
    on_body = ((of_body - 1.0).abs() < 1e-3).any(1)
    assert int(hits.found.sum()) > 1000
    assert float((on_floor | on_body)[hits.found].float().mean()) > 0.995


def test_matches_lie_at_one_place(pair: Pair) -> None:
    found = correspondences(pair)
    there = seen_from(pair.b.T_wc, pair.a.points(), pair.a.T_wc)[..., 2]
    depth = looked_up(pair.b.depth[:, None], found.pixels)[:, 0]
    error = ((depth - there).abs() / there)[found.visible]
    assert found.visible.float().mean() > 0.3
    assert float(error.median()) < 2e-3


def test_warped_by_its_depth_the_second_picture_is_the_first_to_sub_pixel(pair: Pair) -> None:
    found = correspondences(pair)

    def difference(dx: float, dy: float) -> float:
        moved = looked_up(pair.b.image, found.pixels + torch.tensor([dx, dy]))
        return float((moved - pair.a.image).abs().mean(1)[found.visible].mean())

    exact = difference(0.0, 0.0)
    for dx, dy in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
        assert exact < 0.9 * difference(dx, dy)


def test_a_second_look_is_what_a_turned_camera_sees(scene: SceneBatch, pair: Pair) -> None:
    R = rotation(torch.tensor([0.05, -0.08, 0.5]).expand(BATCH, 3))
    turned = turned_view(pair.a, pair.a.K, R, WIDTH, HEIGHT)
    fresh = render_view(Draw(0), scene, turned.K, turned.T_wc, WIDTH, HEIGHT)
    both = turned.valid & fresh.valid
    error = ((turned.depth - fresh.depth).abs() / fresh.depth)[both]
    assert both.float().mean() > 0.4
    assert float(error.quantile(0.95)) < 0.01
    assert float((turned.image - fresh.image).abs().mean(1)[both].mean()) < 0.03


def test_a_view_and_its_second_look_match_exactly(pair: Pair) -> None:
    R = rotation(torch.tensor([0.0, 0.0, 0.4]).expand(BATCH, 3))
    turned = turned_view(pair.a, pair.a.K, R, WIDTH, HEIGHT)
    found = correspondences(Pair(turned, pair.a))
    rays = turned.rays(HEIGHT, WIDTH) @ R[:, None].mT
    focal = torch.stack([pair.a.K[:, 0, 0], pair.a.K[:, 1, 1]], -1)[:, None, None]
    expected = rays[..., :2] / rays[..., 2:] * focal + pair.a.K[:, None, None, :2, 2]
    assert torch.allclose(found.pixels[found.visible], expected[found.visible], atol=2e-2)
    assert float(found.visible[turned.valid].float().mean()) > 0.9


def test_the_same_seed_gives_the_same_pair_and_another_one_another() -> None:
    one, same, other = (
        render_pairs(Draw(seed), 2, 32, 24, TRAINING, COARSE).b for seed in (7, 7, 8)
    )
    assert torch.equal(one.image, same.image)
    assert torch.equal(one.depth, same.depth)
    assert not torch.equal(one.depth, other.depth)


def test_a_view_without_any_depth_has_a_median_all_the_same() -> None:
    empty = torch.zeros(1, HEIGHT, WIDTH)
    K, T_wc = torch.eye(3)[None], torch.eye(4)[None]
    view = ViewBatch(torch.zeros(1, 3, HEIGHT, WIDTH), empty, K, T_wc, empty > 0)
    assert median_depth(view).tolist() == [2.0]


def test_distance_averages_texture_instead_of_aliasing_it(scene: SceneBatch) -> None:
    places = Draw(1).uniform(BATCH, 4000, 2)
    material = torch.zeros(BATCH, 4000, dtype=torch.int64)
    spread = [
        scene.materials.albedo(places, torch.full((BATCH, 4000), footprint), material).std(-1)
        for footprint in (1e-4, 3e-2, 2e-1)
    ]
    assert (spread[0] > spread[1]).all()
    assert (spread[1] > spread[2]).all()
    means = [
        scene.materials.albedo(places, torch.full((BATCH, 4000), footprint), material).mean(-1)
        for footprint in (1e-4, 2e-1)
    ]
    assert torch.allclose(*means, atol=0.03)
