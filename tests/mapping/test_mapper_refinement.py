"""The mapper after the last frame: refinement, fits of the water, held-out views."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.config import OptimiserConfig
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.optimisation import Rates, refining_rates
from tests.mapping.mapping_scenes import (
    cloud,
    copied,
    error,
    filmed,
    floor,
    grown,
    picture,
    pose,
    renderer,
    same,
    settings,
    view_of,
)

SHORT = {"refine_steps": 12}
DRY = settings(optimiser=SHORT)
WET = settings(optimiser=SHORT, medium={"enabled": True})


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
    monkeypatch.setattr(
        mapper.optimiser, "step", lambda view, refine_pose: used.append(view.frame_index)
    )
    mapper.refine()
    for turn in range(3):
        assert sorted(used[4 * turn : 4 * turn + 4]) == [0, 1, 2, 3]


def test_poses_are_held_when_their_rate_is_zero() -> None:
    mapper = grown(settings(optimiser={"poses": 0.0, "refine_steps": 5}))
    poses = [view.T_wc for view in mapper.views]
    mapper.refine()
    assert [view.T_wc for view in mapper.views] == poses


def test_no_refinement_steps_change_nothing() -> None:
    mapper = grown(settings(optimiser={"refine_steps": 0}, medium={"fit": False}))
    before = copied(mapper)
    mapper.refine()
    assert same(copied(mapper), before)


def test_all_rates_have_fallen_when_refining_ends() -> None:
    mapper = grown(DRY)
    mapper.refine()
    rates, ended = DRY.optimiser, mapper.optimiser.adam.learning_rates
    assert ended["means"] == pytest.approx(rates.means * rates.means_final * rates.settle_final)
    for name in ("quats", "log_scales", "opacity_logits", "raw_colours"):
        assert ended[name] == pytest.approx(getattr(rates, name) * rates.settle_final)


def test_rates_other_than_the_means_fall_in_the_last_share_of_refining_only() -> None:
    config = OptimiserConfig(means_final=0.5, settle_share=0.25, settle_final=0.01)
    assert refining_rates(0.0, config) == Rates(1.0, 1.0)
    assert refining_rates(0.75, config) == Rates(pytest.approx(0.5**0.75), 1.0)
    assert refining_rates(1.0, config) == Rates(pytest.approx(0.005), pytest.approx(0.01))
    assert refining_rates(1.0, OptimiserConfig(settle_share=0.0)).others == 1.0


def test_rates_fall_in_the_time_that_refining_has() -> None:
    mapper, ticks = grown(settings(optimiser={"refine_steps": 50})), itertools.count()
    mapper.refine(until=Deadline(40.5, lambda: float(next(ticks))))
    rates = DRY.optimiser
    assert mapper.optimiser.adam.learning_rates["log_scales"] == pytest.approx(
        rates.log_scales * rates.settle_final, rel=0.4
    )


def test_the_clock_decides_nothing_while_the_steps_are_in_time() -> None:
    tables = []
    for tick_s in (0.01, 0.3):
        mapper, ticks = grown(settings(optimiser={"refine_steps": 8})), itertools.count()
        mapper.refine(until=Deadline(10.0, lambda s=tick_s, t=ticks: s * next(t)))
        tables.append(copied(mapper))
    assert same(*tables)


def test_refinement_ends_when_its_time_is_up() -> None:
    mapper, ticks = grown(settings(optimiser={"refine_steps": 50})), itertools.count()
    mapper.refine(until=Deadline(4.5, lambda: float(next(ticks))))
    assert mapper.steps == 3  # the first look at the clock is before the fit of the water


def test_without_any_time_nothing_is_refined_and_no_water_fitted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = grown(WET)
    monkeypatch.setattr(mapper.water_fitting, "at_once", lambda views: pytest.fail("fitted"))
    before = mapper.steps
    mapper.refine(until=Deadline(0.0))
    assert mapper.steps == before


def test_the_water_is_fitted_before_refining(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = grown(settings(optimiser={"refine_steps": 1}))
    fits: list[int] = []
    note = lambda *views_and_ground: fits.append(mapper.steps)  # noqa: E731
    monkeypatch.setattr(mapper.water_fitting, "at_once", note)
    before = mapper.steps
    mapper.refine()
    assert fits == [before]


# --- held-out views -------------------------------------------------------------------------------


def test_registering_moves_the_pose_towards_the_truth_and_nothing_of_the_map() -> None:
    mapper = Mapper(settings(optimiser={"heldout_steps": 8}), renderer(), 0)
    mapper.scene.gaussians = cloud()
    true = pose((0.05, 0.02, 0.0), (0.0, 0.01, 0.02))
    view = view_of(picture(cloud(), true), pose((0.06, 0.01, 0.01), (0.01, 0.0, 0.02)))
    start, before = np.linalg.norm((view.T_wc.inverse() @ true).log()), copied(mapper)
    mapper.register(view)
    assert np.linalg.norm((view.T_wc.inverse() @ true).log()) < 0.1 * start
    assert same(copied(mapper), before)
    assert mapper.steps == 0
    assert view not in mapper.views


def test_a_held_out_view_is_lit_as_its_neighbours_in_time_and_not_as_its_own_picture() -> None:
    mapper = grown(DRY, count=3)
    for view, gain in zip(mapper.views, (0.0, 0.2, 0.4), strict=True):
        view.log_gain = torch.full((3,), gain, dtype=torch.float64)
    view = filmed(floor(), [pose((0.05, 0.0, 0.0))])[0]
    view.frame_index = mapper.views[1].frame_index
    mapper.take_light(view)
    assert view.log_gain.tolist() == pytest.approx([0.2] * 3)


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
