"""Light that plays over the scene: seen, told from the map's errors, and left out of the map."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from aquaflow.config import SunlightConfig
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View
from aquaflow.water.sunlight import (
    COLUMNS,
    FEWEST_VIEWS,
    MAX_LOG_GAIN,
    TOWARDS_ONE,
    Sunlight,
    columns_of_light,
    learn_light,
    light_at,
    light_over,
)
from tests.mapping.mapping_scenes import filmed, floor, path, renderer, settings, view_of

SOLID = torch.ones(48, 64)
LEFT, RIGHT = slice(None, 24), slice(40, None)


def drawn() -> torch.Tensor:
    return 0.2 + 0.3 * torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))


def sunny_on_the_left(gain: float = 1.3) -> View:
    picture = drawn()
    picture[:, :32] *= gain
    return view_of((255.0 * picture).round().clamp(0, 255).to(torch.uint8).numpy())


def lit_by(*log_gains: float) -> list[View]:
    views = [view_of(np.zeros((2, 2, 3), np.uint8), index=10 * i) for i in range(len(log_gains))]
    for view, log_gain in zip(views, log_gains, strict=True):
        view.light = torch.full((3, 3, 4), log_gain)
    return views


def swell(count: int, period: float, height: float = 0.1) -> list[View]:
    return lit_by(*(height * math.sin(2.0 * math.pi * i / period) for i in range(count)))


def test_light_is_learned_where_it_falls() -> None:
    view = sunny_on_the_left()
    learn_light(view, drawn(), SOLID)
    gain = light_over(view, COLUMNS[-1])
    assert gain is not None
    expected = 1.3 ** (1.0 - TOWARDS_ONE)
    np.testing.assert_allclose(gain[:, LEFT].mean(), expected, atol=0.02)
    np.testing.assert_allclose(gain[:, RIGHT].mean(), 1.0, atol=0.02)


@pytest.mark.parametrize("what", ["bare", "vehicle", "not finite"])
def test_a_picture_that_says_nothing_leaves_the_light_as_it_was(what: str) -> None:
    view, picture, alpha = sunny_on_the_left(), drawn(), SOLID.clone()
    before = view.light = torch.full((3, 18, 24), 0.1)
    if what == "bare":
        alpha[:] = 0.5
    elif what == "vehicle":
        view.mask = np.zeros((48, 64), bool)
    else:
        picture[:] = torch.nan
    learn_light(view, picture, alpha)
    assert torch.equal(view.light, before)


@pytest.mark.parametrize("darkness", [0.0, -0.05])
def test_the_light_is_bounded_where_the_map_is_black(darkness: float) -> None:
    view = view_of(np.full((48, 64, 3), 240, np.uint8))
    learn_light(view, torch.full((48, 64, 3), darkness), SOLID)
    assert view.light is not None
    assert float(view.light.abs().max()) <= MAX_LOG_GAIN


def test_a_view_that_was_never_mapped_lies_between_its_neighbours() -> None:
    views = lit_by(0.0, 0.4)
    for index, expected in ((5, 0.2), (-3, 0.0), (99, 0.4)):
        found = light_at(index, views)
        assert found is not None
        torch.testing.assert_close(found, torch.full((3, 3, 4), expected))
    assert light_at(5, [view_of(np.zeros((2, 2, 3), np.uint8))]) is None


def test_fields_that_follow_each_other_are_light_and_random_or_constant_ones_are_not() -> None:
    assert columns_of_light(swell(40, period=12.0))
    assert not columns_of_light(swell(40, period=2.2))  # each unlike its neighbours: errors
    assert not columns_of_light(swell(40, period=12.0, height=0.005))
    assert not columns_of_light(lit_by(*[0.3] * 40))  # a lamp: the camera's shading
    assert not columns_of_light(swell(FEWEST_VIEWS - 1, period=12.0))


@pytest.mark.parametrize("finest", COLUMNS)
def test_light_is_as_fine_as_neighbours_predict_and_no_finer(finest: int) -> None:
    """Patterns of every fineness; those up to ``finest`` drift, the others are drawn anew."""
    random = np.random.default_rng(0)
    patterns = {n: random.normal(size=(2, 3, round(0.75 * n), n)) for n in COLUMNS}
    views = lit_by(*[0.0] * 60)
    for i, view in enumerate(views):
        turn = 2.0 * math.pi * i / 12.0
        light = torch.zeros(3, 18, 24)
        for n, (a, b) in patterns.items():
            drifts = math.cos(turn) * a + math.sin(turn) * b
            cells = drifts if n <= finest else random.normal(size=a.shape)
            light += torch.nn.functional.interpolate(
                0.05 * torch.tensor(cells, dtype=torch.float32)[None], (18, 24)
            )[0]
        view.light = light
    assert columns_of_light(views) == finest


def test_without_the_switch_nothing_is_learned_and_nothing_plays() -> None:
    light, view = Sunlight(SunlightConfig(enabled=False)), sunny_on_the_left()
    light.learn(view, drawn(), SOLID, exposure=None)
    light.judge(swell(40, period=12.0))
    assert light.over(view, exposure=None) is None
    assert view.light is None
    assert light.columns == 0


def test_what_plays_is_drawn_and_taken_out_again() -> None:
    light, view = Sunlight(SunlightConfig()), sunny_on_the_left()
    light.judge(swell(40, period=12.0))
    light.learn(view, drawn(), SOLID, exposure=None)
    gains = light.over(view, exposure=None)
    assert gains is not None
    assert float((drawn() * gains - view.target()).abs().mean()) < 0.02


def test_what_the_exposure_explains_is_no_light() -> None:
    light, view, exposure = Sunlight(SunlightConfig()), sunny_on_the_left(), torch.full((3,), 0.8)
    light.judge(swell(40, period=12.0))
    light.learn(view, drawn(), SOLID, exposure=None)
    alone = light.over(view, exposure=None)
    light.learn(view, drawn() / exposure, SOLID, exposure)
    both = light.over(view, exposure)
    assert alone is not None
    assert both is not None
    torch.testing.assert_close(both, 0.8 * alone)


def test_without_light_the_exposure_alone_is_over_a_view() -> None:
    exposure = torch.full((3,), 0.8)
    assert Sunlight(SunlightConfig()).over(sunny_on_the_left(), exposure) is exposure


def test_a_map_in_playing_light_is_that_of_its_mean() -> None:
    true = floor()
    views = filmed(true, 3 * path(8))
    for i, view in enumerate(views):
        gain = np.exp(0.3 * math.sin(2.0 * math.pi * i / 8.0) * np.linspace(1, -1, 64))
        image = (view.image * gain[None, :, None]).clip(0, 255).astype(np.uint8)
        views[i] = view_of(image, view.T_wc, view.frame_index)
    errors = {}
    for enabled in (False, True):
        config = settings(
            optimiser={"refine_steps": 96, "poses": 0.0, "noise_floor": 0.0},
            sunlight={"enabled": enabled},
            medium={"fit": False},  # pictures clipped at white are darker at their edges
        )
        mapper = Mapper(config, renderer(), 0)
        for view in views[:10] + views[11:]:
            mapper.add_view(view)
        mapper.scene.gaussians = floor()
        mapper.optimiser.adam.extend(len(true))
        mapper.optimiser.adam.bind(mapper.gaussians.parameters)
        mapper.refine()
        assert (mapper.scene.sunlight.columns > 0) is enabled
        mapper.take_light(views[10])
        mapper.register(views[10])
        errors[enabled] = float((mapper.show(views[10]).image - views[10].target()).abs().mean())
    assert errors[True] < 0.7 * errors[False]
