"""Maps that follow the graph: what fails for one sub-map leaves the others, and itself, whole."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
import pytest

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.config import Config
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.maps import Maps
from aquaflow.render.adam import SelectiveAdam
from tests.mapping.mapping_scenes import grown, settings

pytestmark = pytest.mark.usefixtures("contained", "one_thread")

ASIDE = {0: Sim3(np.eye(3), np.array([1.0, 0.0, 0.0]))}
"""Moves of keyframes."""


def two_maps(config: Config | None = None) -> Maps:
    maps = Maps(config or Config(mapping=settings()))
    maps.mappers.update({number: grown(settings()) for number in (0, 1)})
    for mapper in maps.mappers.values():
        mapper.failures = maps.failures
    return maps


def once(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
    """Let a method do its work, raise, and never raise again."""
    method: Callable[..., Any] = getattr(owner, name)

    def failing(*arguments: Any) -> None:
        monkeypatch.setattr(owner, name, method)
        raise RuntimeError("once")

    monkeypatch.setattr(owner, name, failing)


def failed_stages(maps: Maps) -> list[str]:
    return [entry["stage"] for entry in maps.failures.to_json()]


def is_usable(mapper: Mapper) -> bool:
    """Every row of the optimiser belongs to a Gaussian, and steps can be taken."""
    before = mapper.steps
    mapper.optimise(2)
    return len(mapper.optimiser.adam.steps) == len(mapper.gaussians) and mapper.steps == before + 2


def test_two_sub_maps_become_one() -> None:
    maps = two_maps()
    count = sum(len(mapper.gaussians) for mapper in maps.mappers.values())
    maps.correct({}, {1: 0})
    assert list(maps.mappers) == [0]
    assert len(maps.mappers[0].gaussians) == count
    assert is_usable(maps.mappers[0])


def test_maps_share_the_time_for_refining_by_their_views(monkeypatch: pytest.MonkeyPatch) -> None:
    maps, given = two_maps(), []
    extra = [copy(view) for view in maps.mappers[1].views for _ in range(2)]
    maps.mappers[1].views += extra  # three times as many

    def refine(self: Mapper, progress: object, until: Deadline) -> None:
        given.append(until.left_s)

    monkeypatch.setattr(Mapper, "refine", refine)
    maps.refine(until=Deadline(400.0, lambda: 7.0))
    assert given == [100.0, 400.0]  # what the first leaves is the second's


def test_the_configs_limit_is_for_all_maps_together(monkeypatch: pytest.MonkeyPatch) -> None:
    config = Config(mapping=settings(optimiser={"refine_seconds": 20.0}))
    maps, given = two_maps(config), []
    monkeypatch.setattr(Mapper, "refine", lambda self, _, until: given.append(until.left_s))
    maps.refine()
    assert 5.0 < given[0] <= 10.0


def test_held_out_views_follow_their_keyframes() -> None:
    maps = two_maps()
    held_out = maps.mappers[0].views.pop()
    maps.hold_out(held_out, sub_map=0)
    before = held_out.T_wc.t[0]
    maps.correct(ASIDE, {})
    assert held_out.T_wc.t[0] - before == pytest.approx(1.0)


def test_views_of_a_keyframe_that_was_solved_again_get_their_new_poses() -> None:
    maps = two_maps()
    held_out = maps.mappers[0].views.pop()
    maps.hold_out(held_out, sub_map=0)
    views = [held_out, *maps.mappers[0].views, *maps.mappers[1].views]
    held_out.keyframe, others = 77, views[2:]
    views[1].keyframe = 77
    before = [view.T_wc.t.copy() for view in views]
    aside = Sim3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    maps.carry(77, lambda T_wc: aside @ T_wc)
    for view, t in zip(views, before, strict=True):
        expected = t if any(view is other for other in others) else t + aside.t
        np.testing.assert_allclose(view.T_wc.t, expected)


def test_a_merge_that_fails_after_the_gaussians_came_over_is_a_merge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = two_maps()
    count = sum(len(mapper.gaussians) for mapper in maps.mappers.values())
    views = sum(len(mapper.views) for mapper in maps.mappers.values())
    once(monkeypatch, SelectiveAdam, "extend")
    maps.correct({}, {1: 0})
    assert failed_stages(maps) == ["merging of maps"]
    assert list(maps.mappers) == [0]
    assert (len(maps.mappers[0].gaussians), len(maps.mappers[0].views)) == (count, views)
    assert is_usable(maps.mappers[0])


def test_a_merge_that_fails_before_leaves_two_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = two_maps()
    counts = [len(mapper.gaussians) for mapper in maps.mappers.values()]
    once(monkeypatch, GaussianMap, "append")
    maps.correct({}, {1: 0})
    assert failed_stages(maps) == ["merging of maps"]
    assert [len(mapper.gaussians) for mapper in maps.mappers.values()] == counts
    assert all(is_usable(mapper) for mapper in maps.mappers.values())


def test_a_move_that_fails_in_one_map_is_made_in_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = two_maps()
    before = [mapper.gaussians.means.clone() for mapper in maps.mappers.values()]
    once(monkeypatch, Mapper, "move")
    maps.correct(ASIDE, {})
    assert failed_stages(maps) == ["correction of the map"]
    shifts = [
        float((mapper.gaussians.means - old)[:, 0].mean())
        for mapper, old in zip(maps.mappers.values(), before, strict=True)
    ]
    assert shifts == pytest.approx([0.0, 1.0], abs=1e-4)
    assert all(is_usable(mapper) for mapper in maps.mappers.values())
