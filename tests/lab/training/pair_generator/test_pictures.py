"""Water, sensor, windows and the pool: fresh each time, and repeatable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aquaflow.lab.training.pair_generator.cameras import TRAINING
from aquaflow.lab.training.pair_generator.drawing import (
    WindowVariation,
    through_water,
    training_pair,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import BRIGHTEST, median_depth, render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.sensor import take_picture
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, STRIDE, Pool
from aquaflow.lab.training.pair_generator.water import MOST_ATTENUATION, random_water
from aquaflow.lab.training.pairs import Pair, overlap

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 48, 36
COARSE = Detail(terrain=64, texture=128)
LOOKS = WindowVariation(width=32, height=24)


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Pool:
    pool = Pool(tmp_path_factory.mktemp("pool"), 5, WIDTH, HEIGHT, detail=COARSE)
    pool.ensure(0)
    return pool


@pytest.fixture(scope="module")
def clear(pool: Pool) -> Pair:
    return pool.pairs(torch.arange(SHARD))


def test_the_open_water_and_what_is_far_take_the_water_s_colour(clear: Pair) -> None:
    water = random_water(Draw(1), median_depth(clear.a))
    far = replace(clear.a, depth=torch.full_like(clear.a.depth, 900.0))
    nothing = replace(clear.a, depth=torch.zeros_like(clear.a.depth))
    colour = water.B_inf[..., None, None].expand_as(clear.a.image)
    for view in (far, nothing):
        assert torch.allclose(water.through(view), colour, atol=0.02)


def test_no_water_is_so_murky_that_nothing_is_seen(clear: Pair) -> None:
    median = median_depth(clear.a)
    for seed in range(20):
        depth = random_water(Draw(seed), median).beta_a.amin(1) * median
        assert float(depth.max()) <= MOST_ATTENUATION * 1.001


@pytest.mark.parametrize("level", [0.0, 1e-3, 1.0, 1e4])
def test_a_picture_is_between_black_and_white_whatever_the_light(level: float) -> None:
    image = take_picture(Draw(2), torch.full((3, 3, HEIGHT, WIDTH), level))
    assert bool(torch.isfinite(image).all())
    assert float(image.min()) >= 0.0
    assert float(image.max()) <= 1.0


def test_each_use_of_a_pair_has_another_water_and_window(clear: Pair) -> None:
    one, same, other = (training_pair(Draw(seed), clear, LOOKS) for seed in (1, 1, 2))
    assert torch.equal(one.a.image, same.a.image)
    assert torch.equal(one.b.T_wc, same.b.T_wc)
    assert not torch.equal(one.a.image, other.a.image)
    assert not torch.equal(one.b.K, other.b.K)
    assert one.a.image.shape == (SHARD, 3, LOOKS.height, LOOKS.width)


def test_pages_of_a_pair_see_the_same_place_mostly(clear: Pair) -> None:
    shares = torch.cat([overlap(training_pair(Draw(seed), clear, LOOKS)) for seed in range(8)])
    assert float(shares.median()) > 0.3


def test_pairs_of_one_place_have_no_baseline(clear: Pair) -> None:
    pair = training_pair(Draw(3), clear, replace(LOOKS, same_place=1.0))
    assert torch.equal(pair.a.T_wc[:, :3, 3], pair.b.T_wc[:, :3, 3])
    assert not torch.equal(pair.a.T_wc[:, :3, :3], pair.b.T_wc[:, :3, :3])


def test_water_changes_no_geometry(clear: Pair) -> None:
    wet = through_water(Draw(4), clear)
    assert torch.equal(wet.a.depth, clear.a.depth)
    assert torch.equal(wet.b.valid, clear.b.valid)


def test_a_pool_holds_what_was_rendered(pool: Pool, clear: Pair) -> None:
    rendered = render_pairs(Draw(5 * STRIDE), SHARD, WIDTH, HEIGHT, TRAINING, COARSE)
    assert torch.allclose(clear.a.image, rendered.a.image, atol=BRIGHTEST / 255.0)
    assert torch.allclose(clear.b.depth, rendered.b.depth, rtol=1e-3)
    assert torch.equal(clear.b.T_wc, rendered.b.T_wc)


def test_a_shard_follows_from_its_number_whoever_renders_it(pool: Pool, tmp_path: Path) -> None:
    elsewhere = Pool(tmp_path, pool.seed, WIDTH, HEIGHT, detail=COARSE)
    assert elsewhere.ensure(0)
    assert not elsewhere.ensure(0)
    numbers = torch.tensor([6, 1, 1])
    assert torch.equal(elsewhere.pairs(numbers).b.image, pool.pairs(numbers).b.image)
