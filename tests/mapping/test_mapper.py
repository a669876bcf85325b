"""The mapper: it learns, it repeats itself, and bad numbers cost a step and not the map."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from mapping_scenes import (
    CAMERA,
    cloud,
    copied,
    error,
    filmed,
    flat_pointmap,
    floor,
    grown,
    path,
    picture,
    pose,
    renderer,
    settings,
    view_of,
)

from aquaflow.config import MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.mapping import mapper as module
from aquaflow.mapping.mapper import Mapper

SHORT = {"refine_steps": 12}
DRY = settings(optimiser=SHORT)
WET = settings(optimiser=SHORT, medium={"enabled": True})


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


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


def test_the_outlier_mask_protects_the_map_from_common_frames_only() -> None:
    for robust in (True, False):
        mapper = grown(settings(loss={"scale": 0.0, "depth": 0.0}), count=1)
        mapper.optimise(40)
        wrong = view_of(255 - picture(floor(), path(1)[0]) // 8, robust=robust)
        before = copied(mapper)["raw_colours"]
        mapper.views = [wrong]
        mapper.optimise(1)
        learnt = (copied(mapper)["raw_colours"] - before).abs().amax(dim=1) > 0
        assert bool(learnt.float().mean() < 0.05) == robust


def test_masked_pixels_teach_nothing() -> None:
    mapper = grown(settings(loss={"scale": 0.0}), count=1)
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


# --- inserting ------------------------------------------------------------------------------------


def dense(**keys: object) -> MappingConfig:
    """Every pixel that may get a Gaussian gets one."""
    insertion = {"density": 1.0, "bare_probability": 1.0}
    stages = {"insertion": insertion, "medium": {"enabled": False}, **keys}
    return MappingConfig.model_validate(stages)


def test_only_pixels_of_known_range_get_gaussians() -> None:
    mapper, pointmap = Mapper(dense(), renderer(), 0), flat_pointmap()
    pointmap.variance[:, 20:] = 1.0
    pointmap.rho[:10] = 0.0
    assert mapper.insert(view_of(picture(floor(), path(1)[0])), pointmap) == 38 * 20
    at = CAMERA.project(mapper.gaussians.means.numpy())
    assert at[:, 0].max() < 20.0
    assert at[:, 1].min() > 10.0


def test_masked_pixels_get_no_gaussians() -> None:
    mapper, view = Mapper(dense(), renderer(), 0), view_of(picture(floor(), path(1)[0]))
    view.mask = np.zeros((48, 64), bool)
    view.mask[:, :16] = True
    assert mapper.insert(view, flat_pointmap()) == 48 * 16
    assert CAMERA.project(mapper.gaussians.means.numpy())[:, 0].max() < 16.0


def test_pixels_that_the_water_hides_get_no_gaussians() -> None:
    murky = dense(medium={"initial_attenuation": 2.0})  # exp(-4) arrives
    mapper, view = Mapper(murky, renderer(), 0), view_of(picture(floor(), path(1)[0]))
    assert mapper.insert(view, flat_pointmap()) == 0
    pointmap = flat_pointmap()
    pointmap.rho[:, :10] = 1.0  # exp(-2)
    assert mapper.insert(view, pointmap) > 0
    assert CAMERA.project(mapper.gaussians.means.numpy())[:, 0].max() < 10.0


def test_the_cap_is_hard_and_cuts_no_corner_of_the_picture_off() -> None:
    mapper = Mapper(dense(max_gaussians=1000), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    assert mapper.insert(view, flat_pointmap()) == 1000
    rows = CAMERA.project(mapper.gaussians.means.numpy())[:, 1]
    assert 0.3 < float((rows > 24.0).mean()) < 0.7
    assert mapper.insert(view_of(view.image, pose((0.0, 0.0, -9.0))), flat_pointmap()) == 0
    assert len(mapper.gaussians) == 1000


def test_a_surface_elsewhere_than_the_map_says_gets_gaussians_again() -> None:
    mapper = Mapper(dense(), renderer(), 0)
    view = view_of(np.full((48, 64, 3), 120, np.uint8))
    first = mapper.insert(view, flat_pointmap())
    assert mapper.insert(view, flat_pointmap()) < 0.2 * first
    assert mapper.insert(view, flat_pointmap(depth=1.0)) > 0.5 * first


def test_the_priors_range_stays_with_the_view_even_when_nothing_is_inserted() -> None:
    mapper = Mapper(settings(insertion={"tau_a": 1.0}), renderer(), 0)
    view = view_of(np.full((48, 64, 3), 120, np.uint8))
    pointmap = flat_pointmap()
    pointmap.rho[0, 0] = 0.0
    assert mapper.insert(view, pointmap) == 0
    assert view.inverse_range is not None
    assert view.range_confidence is not None
    assert float(view.inverse_range[0, 0]) == 0.0
    assert float(view.range_confidence[0, 0]) == 0.0
    assert float(view.inverse_range[24, 32]) == pytest.approx(0.5, rel=1e-3)
    assert 0.9 < float(view.range_confidence[24, 32]) < 1.0


def test_new_gaussians_belong_to_the_views_keyframe() -> None:
    mapper = Mapper(dense(), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    view.keyframe = 7
    mapper.insert(view, flat_pointmap())
    assert mapper.gaussians.keyframes.unique().tolist() == [7]


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


# --- refining -------------------------------------------------------------------------------------


def test_refining_moves_poses_but_the_first_and_improves_the_map() -> None:
    mapper = grown(DRY)
    poses, before, told = [view.T_wc for view in mapper.views], error(mapper), []
    mapper.refine(lambda done, total: told.append((done, total)))
    assert mapper.views[0].T_wc is poses[0]
    assert all(view.T_wc is not old for view, old in zip(mapper.views[1:], poses[1:], strict=True))
    assert error(mapper) < before
    assert told == [(i, 12) for i in range(1, 13)]


def test_refining_uses_every_view_equally_often(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, used = grown(DRY), []
    monkeypatch.setattr(mapper, "_step", lambda view, refine_poses: used.append(view.frame_index))
    mapper.refine()
    for turn in range(3):
        assert sorted(used[4 * turn : 4 * turn + 4]) == [0, 1, 2, 3]


def test_poses_are_held_when_their_rate_is_zero() -> None:
    mapper = grown(settings(optimiser={"poses": 0.0, "refine_steps": 5}))
    poses = [view.T_wc for view in mapper.views]
    mapper.refine()
    assert [view.T_wc for view in mapper.views] == poses


def test_no_refinement_steps_change_nothing() -> None:
    mapper = grown(settings(optimiser={"refine_steps": 0}))
    before = copied(mapper)
    mapper.refine()
    assert same(copied(mapper), before)


def test_the_rate_of_the_means_falls_to_its_final_share() -> None:
    mapper = grown(DRY)
    mapper.refine()
    rates = DRY.optimiser
    assert mapper._optimiser.learning_rates["means"] == pytest.approx(
        rates.means * rates.means_final
    )


def test_refinement_ends_when_its_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = grown(settings(optimiser={"refine_steps": 50, "refine_seconds": 3.5}))
    ticks = itertools.count()
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(ticks)))
    mapper.refine()
    assert mapper.steps == 3


def test_water_is_fitted_at_its_view_count_at_every_doubling_and_before_refining(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = Mapper(settings(medium={"first_fit_views": 3}), renderer(), 0)
    fits: list[int] = []
    monkeypatch.setattr(mapper, "fit_water", lambda: fits.append(len(mapper.views)))
    for view in filmed(floor(), path(1)) * 13:
        mapper.add_view(view)
    assert fits == [3, 6, 12]
    mapper.refine()
    assert fits == [3, 6, 12, 13]


def test_a_fit_looks_at_views_spread_over_the_whole_dive(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = Mapper(settings(medium={"fit_views": 4}), renderer(), 0)
    mapper.views = [view_of(np.zeros((2, 2, 3), np.uint8), index=i) for i in range(31)]
    looked: list[int] = []
    monkeypatch.setattr(
        mapper.scene, "fit_water", lambda views, _: looked.extend(v.frame_index for v in views)
    )
    mapper.fit_water()
    assert looked == [0, 10, 20, 30]


# --- held-out views -------------------------------------------------------------------------------


def test_registering_moves_the_pose_towards_the_truth_and_nothing_of_the_map() -> None:
    mapper = Mapper(settings(optimiser={"heldout_steps": 60}), renderer(), 0)
    mapper.scene.gaussians = cloud()
    true = pose((0.05, 0.02, 0.0), (0.0, 0.01, 0.02))
    view = view_of(picture(cloud(), true), pose((0.06, 0.01, 0.01), (0.01, 0.0, 0.02)))
    start, before = np.linalg.norm((view.T_wc.inverse() @ true).log()), copied(mapper)
    mapper.register(view)
    assert np.linalg.norm((view.T_wc.inverse() @ true).log()) < 0.3 * start
    assert same(copied(mapper), before)
    assert mapper.steps == 0
    assert view not in mapper.views


def test_registering_leaves_the_water_alone() -> None:
    mapper = grown(WET)
    view = filmed(floor(), [pose((0.05, 0.0, 0.0))])[0]
    before = copied(mapper)
    mapper.register(view)
    assert same(copied(mapper), before)
    assert all(parameter.grad is None for parameter in mapper.medium.parameters())


def test_registering_does_not_look_at_masked_pixels() -> None:
    mapper = grown(DRY, count=1)
    view = filmed(floor(), [pose((0.05, 0.0, 0.0))])[0]
    view.mask = np.zeros((48, 64), bool)
    R, t = view.T_wc.R.copy(), view.T_wc.t.copy()
    mapper.register(view)
    np.testing.assert_allclose(view.T_wc.R, R, atol=1e-5)
    np.testing.assert_allclose(view.T_wc.t, t, atol=1e-5)
