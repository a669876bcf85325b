"""The mapper: it learns, it repeats itself, and bad numbers cost a step and not the map."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from aquaflow.config import MappingConfig, OptimiserConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.mapping.mapper import Mapper
from tests.mapping.mapping_scenes import (
    copied,
    error,
    filmed,
    floor,
    grown,
    path,
    picture,
    renderer,
    same,
    settings,
    view_of,
)

SHORT = {"refine_steps": 12}
DRY = settings(optimiser=SHORT)
WET = settings(optimiser=SHORT, medium={"enabled": True})


# --- learning -------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [DRY, WET])
def test_optimising_brings_the_map_closer_to_the_pictures(config: MappingConfig) -> None:
    mapper = grown(config)
    before = error(mapper)
    mapper.optimise(60)
    assert error(mapper) < 0.6 * before
    assert mapper.steps == 60
    assert mapper.undone == 0


@pytest.mark.parametrize("config", [DRY, WET])
def test_the_same_seed_gives_the_same_map_bit_for_bit(config: MappingConfig) -> None:
    maps = []
    for seed in (3, 3, 4):
        mapper = grown(config, seed, threads=2)
        mapper.optimise(15)
        mapper.refine()
        maps.append(copied(mapper))
    assert same(maps[0], maps[1])
    assert maps[0]["means"].shape != maps[2]["means"].shape


def test_steps_without_views_or_gaussians_do_nothing() -> None:
    empty = Mapper(WET, renderer(), seed=0)
    empty.optimise(5)
    empty.refine()
    for view in filmed(floor(), path(2)):
        empty.add_view(view)
    empty.optimise(5)
    empty.refine()
    pose_before = empty.views[1].T_wc
    empty.register(empty.views[1])
    assert empty.views[1].T_wc is pose_before
    assert (empty.steps, empty.undone, len(empty.gaussians)) == (0, 0, 0)


def test_gaussians_without_views_wait() -> None:
    mapper = grown(DRY)
    mapper.views.clear()
    mapper.optimise(5)
    mapper.refine()
    assert mapper.steps == 0


def test_outliers_on_common_frames_count_as_masked_and_on_other_frames_they_teach() -> None:
    maps = []
    wrong = np.where(picture(floor(), path(1)[0]) < 128, 255, 0).astype(np.uint8)
    for robust, mask in ((True, None), (False, np.zeros((48, 64), bool)), (False, None)):
        mapper = grown(settings(optimiser={"noise_floor": 0.0}), count=1)
        mapper.optimise(60)
        mapper.views = [view_of(wrong, robust=robust)]
        mapper.views[0].mask = mask
        mapper.optimise(1)
        maps.append(copied(mapper))
    assert same(maps[0], maps[1])
    assert not same(maps[1], maps[2])


def test_masked_pixels_teach_nothing() -> None:
    mapper = grown(settings(loss={"scale": 0.0}, optimiser={"noise_floor": 0.0}), count=1)
    before = copied(mapper)
    mapper.views[0].mask = np.zeros((48, 64), bool)
    mapper.optimise(3)
    assert same(copied(mapper), before)
    assert mapper.steps == 3


def test_depth_pulls_the_map_to_the_priors_range() -> None:
    shown = []
    for weight in (0.0, 1.0):
        mapper = grown(settings(loss={"depth": weight}, optimiser={"means": 1e-2}), count=1)
        view = mapper.views[0]
        view.inverse_range = torch.full((48, 64), 1.0 / 1.8)
        view.range_confidence = torch.ones(48, 64)
        mapper.optimise(40)
        shown.append(float(mapper.show(view).z[20:28, 28:36].mean()))
    assert shown[1] < shown[0] - 0.05
    assert shown[1] == pytest.approx(1.8, abs=0.1)


def test_views_of_two_sizes_live_in_one_map() -> None:
    mapper = grown(DRY, count=1)
    half = CameraModel(32, 24, 27.5, 27.5, 16.0, 12.0)
    mapper.add_view(view_of(picture(floor(), path(1)[0], camera=half), index=1, camera=half))
    mapper.optimise(10)
    assert mapper.undone == 0
    assert mapper.steps == 10


# --- bad numbers ----------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_is_undone_and_counted() -> None:
    mapper = grown(WET)
    with torch.no_grad():
        mapper.medium.B_inf_logit.fill_(math.nan)
    before = copied(mapper)
    mapper.optimise(3)
    after = copied(mapper)
    assert all(torch.equal(before[name], after[name]) for name in mapper.gaussians.NAMES)
    assert (mapper.undone, mapper.steps) == (3, 0)


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "raw_colours"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_one_poisoned_gaussian_does_not_stop_the_map_from_learning(name: str, bad: float) -> None:
    mapper = grown(DRY)
    mapper.gaussians.parameters[name][5] = bad
    before = error(mapper)
    mapper.optimise(40)
    assert error(mapper) < 0.8 * before
    assert mapper.undone <= 1
    sound = torch.arange(len(mapper.gaussians)) != 5
    for tensor in mapper.gaussians.parameters.values():
        assert torch.isfinite(tensor[sound]).all()


def test_a_bad_gradient_of_the_medium_costs_the_mediums_step_only() -> None:
    mapper = grown(WET)
    mapper.medium.b_raw.register_hook(lambda gradient: gradient * math.nan)
    before = copied(mapper)
    mapper.optimise(2)
    after = copied(mapper)
    assert mapper.undone == 2
    for name in mapper.medium.state_dict():
        assert torch.equal(before[name], after[name]), name
    assert not torch.equal(before["raw_colours"], after["raw_colours"])


def test_the_water_learns_from_full_looks_alone() -> None:
    mapper, learned = grown(WET), list[int]()
    view = mapper.views[0]
    view.looks = 0
    mapper.medium.b_raw.register_hook(lambda _: learned.append(view.looks))
    for _ in range(2 * OptimiserConfig().full_look_every):
        mapper.optimiser.step(view, refine_pose=False)
    assert len(learned) == 2


# --- pruning --------------------------------------------------------------------------------------


def test_transparent_and_huge_gaussians_are_dropped_and_the_rest_goes_on() -> None:
    mapper = grown(settings(optimiser={"prune_every": 1}), count=1)
    mapper.gaussians.parameters["opacity_logits"][:4] = -8.0
    mapper.gaussians.parameters["log_scales"][4:7] = math.log(2.0)
    count = len(mapper.gaussians)
    mapper.optimise(1)
    assert len(mapper.gaussians) == count - 7
    assert float(mapper.gaussians.opacities.min()) > 0.02
    assert float(mapper.gaussians.scales.max()) < 1.0
    mapper.optimise(5)
    assert mapper.undone == 0


def test_nothing_is_pruned_between_its_turns() -> None:
    mapper = grown(settings(optimiser={"prune_every": 100}), count=1)
    mapper.gaussians.parameters["opacity_logits"][:4] = -8.0
    count = len(mapper.gaussians)
    mapper.optimise(3)
    assert len(mapper.gaussians) == count


def test_a_map_that_is_pruned_to_nothing_stops_quietly() -> None:
    mapper = grown(settings(optimiser={"prune_every": 1}), count=1)
    mapper.gaussians.parameters["opacity_logits"].fill_(-8.0)
    mapper.optimise(5)
    assert len(mapper.gaussians) == 0
    assert mapper.undone == 0
