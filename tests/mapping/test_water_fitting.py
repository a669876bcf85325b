"""The water's fit: when it begins, a few steps at a time, and what interrupts it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.base.errors.failures import Failures
from aquaflow.config import MediumConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping import scene_water as module
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.scene_water import STEPS, WaterFitting, fitting_water, views_to_fit
from aquaflow.mapping.tiles import Sphere, TileFiles
from aquaflow.render.views import View
from aquaflow.water.estimation import WaterEstimate
from aquaflow.water.sightings import MIN_VIEWS
from tests.mapping.mapping_scenes import (
    filmed,
    flat_pointmap,
    floor,
    pose,
    renderer,
    settings,
    view_of,
    water,
)

PAUSES = 5


def views(count: int) -> list[View]:
    return [view_of(np.zeros((2, 2, 3), np.uint8), index=index) for index in range(count)]


class Fits:
    """In place of the fits: each takes PAUSES pauses, and notes what it looked at."""

    def __init__(self) -> None:
        self.looked: list[list[int]] = []
        self.fails = False

    def __call__(
        self,
        scene: Scene,
        views: Sequence[View],
        generator: torch.Generator,
        come_to: Callable[[View], None] | None = None,
    ) -> Generator[None, None, tuple[WaterEstimate | None, list[View]]]:
        self.looked.append([view.frame_index for view in views])
        for _ in range(PAUSES):
            yield
        if self.fails:
            raise ArithmeticError("no water can be this")
        return None, []


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Fits:
    made = Fits()
    monkeypatch.setattr(module, "fitting_water", made)
    return made


def fitting(failures: Failures | None = None, **config: int) -> WaterFitting:
    settings = MediumConfig.model_validate(config)
    generator = torch.Generator().manual_seed(0)
    scene = Scene(settings, renderer(), generator)
    return WaterFitting(settings, scene, generator, failures or Failures())


def test_a_fit_begins_at_its_view_count_and_at_every_doubling(fits: Fits) -> None:
    paced = fitting(first_fit_views=3)
    dive = views(40)
    began = []
    for count in range(1, 41):
        before = len(fits.looked)
        paced.go_on(dive[:count])
        began += [count] if len(fits.looked) > before else []
    assert began == [3, 2 * 5, 2 * 12]  # each ends two views later


def test_only_a_few_steps_are_made_with_each_view(fits: Fits) -> None:
    paced = fitting(first_fit_views=2)
    ended = [paced.go_on(views(2)) for _ in range(PAUSES // STEPS + 1)]
    assert ended == [False] * (PAUSES // STEPS) + [True]


def test_at_once_is_a_whole_fit(fits: Fits) -> None:
    paced = fitting()
    paced.at_once(views(7))
    assert fits.looked == [list(range(7))]
    assert not paced.go_on(views(8))


def test_a_fit_looks_at_views_spread_over_the_whole_dive(fits: Fits) -> None:
    fitting(fit_views=4).at_once(views(31))
    assert fits.looked == [[0, 10, 20, 30]]


def test_a_fit_begins_again_when_the_maps_unit_has_changed(fits: Fits) -> None:
    paced = fitting(first_fit_views=2)
    paced.go_on(views(2))
    paced.follow_moves({0: Sim3(np.eye(3), np.array([0.1, 0.0, 0.0]), 1.001)})
    paced.go_on(views(3))
    assert len(fits.looked) == 1
    paced.follow_moves({0: Sim3(np.eye(3), np.zeros(3), 1.1)})
    paced.go_on(views(4))
    assert fits.looked == [[0, 1], [0, 1, 2, 3]]


def test_a_fit_looks_at_views_whose_ground_is_in_memory(fits: Fits) -> None:
    paced = fitting(first_fit_views=2)
    dive = views(9)
    paced.go_on(dive, dive[5:])
    assert fits.looked == [[5, 6, 7, 8]]


def test_a_map_that_has_taken_over_another_is_fitted_with_the_next_view(fits: Fits) -> None:
    paced = fitting(first_fit_views=2)
    paced.at_once(views(8))
    paced.go_on(views(9))
    paced.merge(views(12))
    paced.go_on(views(13))
    assert fits.looked == [list(range(8)), list(range(13))]


# --- which views it looks at ----------------------------------------------------------------------


def survey(
    count: int, step: float, height: Callable[[int], float] = lambda i: 1.0
) -> tuple[list[View], dict[int, Sphere]]:
    """Views that look down along a line, and the ground that each has seen."""
    seen = {}
    line = views(count)
    for i, view in enumerate(line):
        view.keyframe, view.T_wc = i, pose((step * i, 0.0, -height(i)))
        seen[i] = Sphere(np.array([step * i, 0.0, 0.0]), height(i))
    return line, seen


def test_where_all_see_the_same_ground_they_are_spread_over_time() -> None:
    line, seen = survey(60, 0.02)
    chosen = [view.frame_index for view in views_to_fit(line, seen, 6)]
    assert chosen == np.linspace(0, 59, 6).astype(int).tolist()


def test_over_a_long_way_they_are_groups_that_see_the_same_ground() -> None:
    line, seen = survey(2000, 0.1)
    chosen = views_to_fit(line[::-1], seen, 20)
    places = np.array([seen[view.keyframe].centre for view in chosen])
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    assert len(chosen) == 20
    assert [view.frame_index for view in chosen] == sorted(view.frame_index for view in chosen)
    assert ((apart < 1.0).sum(axis=1) >= MIN_VIEWS).all()
    assert np.ptp(places[:, 0]) > 0.6 * 200.0


def test_they_are_never_more_than_were_asked_for() -> None:
    line, seen = survey(2000, 0.1)
    assert len(views_to_fit(line, seen, 4)) == 4


def test_of_one_ground_they_are_those_with_the_most_different_ranges() -> None:
    line, seen = survey(2000, 0.1, lambda i: 1.0 + 0.05 * (i % 7))
    heights = [-view.T_wc.t[2] for view in views_to_fit(line, seen, 20)]
    assert min(heights) == pytest.approx(1.0)
    assert max(heights) == pytest.approx(1.3)


def test_views_whose_ground_is_unknown_are_spread_over_time() -> None:
    line, _ = survey(50, 5.0)
    assert views_to_fit(line, {}, 5) == [line[i] for i in (0, 12, 24, 36, 49)]


def test_a_mappers_fit_knows_the_ground_that_its_keyframes_saw(tmp_path: Path) -> None:
    mapper = Mapper(settings(), renderer(), 0, tiles=TileFiles(tmp_path))
    view = filmed(floor(), [pose((0.0, 0.0, 0.0))])[0]
    mapper.insert(view, flat_pointmap())
    assert mapper.water_fitting._tiles.seen.keys() == {0}


def test_a_fit_that_fails_is_counted_and_not_tried_again_at_once(fits: Fits) -> None:
    fits.fails, failures = True, Failures(strict=False)
    paced = fitting(failures, first_fit_views=2)
    for _ in range(PAUSES):
        paced.go_on(views(3))
    assert len(fits.looked) == 1
    assert failures.total == 1


def submerged() -> Mapper:
    mapper = Mapper(settings(medium={"enabled": True}), renderer(), 0)
    mapper.scene.gaussians = floor(columns=18, rows=14)
    poses = [pose((0.02 * i, 0.0, -0.35 * i)) for i in range(5)]
    mapper.views = filmed(mapper.gaussians, poses, water(beta=0.3, b=0.3))
    return mapper


def test_a_fit_to_the_maps_own_views_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    mapper = submerged()
    with caplog.at_level("INFO", logger="aquaflow.mapping.scene_water"):
        mapper.water_fitting.at_once(mapper.views)
    assert "water fitted" in caplog.text
    assert mapper.scene.beta_a_sigma is not None


def test_a_view_whose_pixels_were_deleted_meanwhile_is_left_out() -> None:
    mapper = submerged()
    steps = fitting_water(mapper.scene, mapper.views, torch.Generator().manual_seed(0))
    next(steps)
    mapper.views[2].delete_pixels()
    while True:
        try:
            next(steps)
        except StopIteration as end:
            _, fitted = end.value
            break
    assert mapper.views[2] not in fitted
    assert len(fitted) == len(mapper.views) - 1


def test_nothing_changes_before_the_end_of_a_fit() -> None:
    mapper = submerged()
    before = mapper.medium.state_dict()["b_raw"].clone()
    for _ in fitting_water(mapper.scene, mapper.views, torch.Generator().manual_seed(0)):
        assert torch.equal(mapper.medium.state_dict()["b_raw"], before)
    assert isinstance(mapper.scene, Scene)
