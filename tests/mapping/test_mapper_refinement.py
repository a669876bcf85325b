"""The mapper after the last frame: refinement, fits of the water, held-out views."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from aquaflow.mapping import mapper as module
from aquaflow.mapping.mapper import Mapper
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


def test_the_rate_of_the_means_falls_to_its_final_share() -> None:
    mapper = grown(DRY)
    mapper.refine()
    rates = DRY.optimiser
    assert mapper.optimiser.adam.learning_rates["means"] == pytest.approx(
        rates.means * rates.means_final
    )


def test_refinement_ends_when_its_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = grown(settings(optimiser={"refine_steps": 50, "refine_seconds": 3.5}))
    ticks = itertools.count()
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(ticks)))
    mapper.refine()
    assert mapper.steps == 3


def test_the_water_is_fitted_before_refining(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = grown(settings(optimiser={"refine_steps": 1}))
    fits: list[int] = []
    monkeypatch.setattr(mapper.water_fitting, "at_once", lambda views: fits.append(mapper.steps))
    before = mapper.steps
    mapper.refine()
    assert fits == [before]


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
