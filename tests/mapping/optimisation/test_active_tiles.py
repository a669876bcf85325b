"""Which tiles a step looks at."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.config import OptimiserConfig
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.optimisation import record_look, tile_errors, tiles_to_draw
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import (
    copied,
    flat_pointmap,
    floor,
    grown,
    path,
    picture,
    renderer,
    settings,
    view_of,
)

CONFIG = OptimiserConfig(noise_floor=0.01, full_look_every=3)


def looked_at(config: OptimiserConfig = CONFIG) -> View:
    """A view whose upper left tile is drawn wrongly, the others within the noise."""
    view = view_of(np.full((48, 64, 3), 128, np.uint8))
    image = view.target() + 0.005
    image[:16, :16] += 0.05
    record_look(view, tile_errors(view, image), config)
    return view


def test_the_first_look_is_at_all_tiles() -> None:
    assert tiles_to_draw(view_of(np.zeros((48, 64, 3), np.uint8)), CONFIG) is None


def test_then_only_tiles_above_the_noise_floor_are_drawn() -> None:
    tiles = tiles_to_draw(looked_at(), CONFIG)
    assert tiles is not None
    assert tiles.nonzero().tolist() == [[0, 0]]
    assert tiles.shape == (3, 4)


def test_now_and_then_everything_is_looked_at_and_remembered_anew() -> None:
    view = looked_at()
    for _ in range(2):
        assert tiles_to_draw(view, CONFIG) is not None
        record_look(view, None, CONFIG)
    assert tiles_to_draw(view, CONFIG) is None
    record_look(view, tile_errors(view, view.target()), CONFIG)
    tiles = tiles_to_draw(view, CONFIG)
    assert tiles is not None
    assert not tiles.any()


def test_without_a_noise_floor_no_tile_is_left_out() -> None:
    always = OptimiserConfig(noise_floor=0.0, full_look_every=3)
    assert tiles_to_draw(looked_at(always), always) is None


def test_tiles_that_show_only_the_vehicle_are_never_drawn() -> None:
    view = view_of(np.zeros((48, 64, 3), np.uint8))
    view.mask = np.ones((48, 64), bool)
    view.mask[:, 30:] = False
    for _ in range(4):
        tiles = tiles_to_draw(view, CONFIG)
        assert tiles is not None
        assert tiles[:, :2].all()
        assert not tiles[:, 2:].any()
        record_look(view, None, CONFIG)


def test_a_step_leaves_alone_what_only_explained_tiles_show() -> None:
    config = settings(optimiser={"noise_floor": 0.01, "full_look_every": 100})
    mapper = Mapper(config, renderer(), 0)
    mapper.scene.gaussians.extend(floor().parameters, keyframe=0)
    mapper.optimiser.adam.extend(len(mapper.gaussians))
    mapper.optimiser.adam.bind(mapper.gaussians.parameters)
    wrong = picture(floor(), path(1)[0])
    wrong[:16, :16] = 255
    mapper.add_view(view_of(wrong))
    mapper.optimise(1)
    before = copied(mapper)
    mapper.optimise(3)
    moved = (copied(mapper)["raw_colours"] != before["raw_colours"]).any(dim=1)
    at = mapper.views[0].camera.project(before["means"].double().numpy())
    assert moved[(at < 12.0).all(axis=1)].all()
    assert not moved[(at > 40.0).any(axis=1)].any()


@pytest.mark.parametrize("skip", [True, False])
def test_a_view_that_is_wholly_explained_costs_no_step_until_its_next_full_look(skip: bool) -> None:
    config = settings(optimiser={"noise_floor": 1.0, "full_look_every": 4, "skip_explained": skip})
    mapper = grown(config, count=1)
    mapper.optimise(8)
    assert mapper.steps == (2 if skip else 8)
    assert mapper.views[0].looks == 8


def test_insertion_looks_at_the_whole_picture() -> None:
    mapper = Mapper(settings(optimiser={"noise_floor": 1.0}), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    mapper.add_view(view)
    view.explained = torch.ones(3, 4, dtype=torch.bool)
    view.looks = 1
    assert mapper.insert(view, flat_pointmap()) > 100
