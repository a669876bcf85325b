"""Gaussians of an earlier dive's map enter this one where a keyframe shows their surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.archive import write_facts_file
from aquaflow.config import Config, MappingConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.mapping.base_gaussians import BaseGaussians, BaseMaps
from aquaflow.mapping.gaussians import GaussianMap, move_gaussians, raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.state import serialise
from aquaflow.mapping.work import Growth
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import (
    FLOOR_M,
    filmed,
    flat_pointmap,
    floor,
    gaussians_at,
    grown,
    picture,
    pose,
    renderer,
    settings,
    view_of,
)

T_MB = Sim3(so3_exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, -2.0, 0.5]), 1.7)
"""Where the earlier dive's world lies in this one's."""


def nothing_new(**keys: object) -> MappingConfig:
    """No pixel gets a Gaussian of the dive's own."""
    return settings(insertion={"tau_a": 1.0}, **keys)  # type: ignore[arg-type]


def earlier(gaussians: GaussianMap, T_mb: Sim3 = T_MB) -> BaseGaussians:
    """What an earlier dive made of ``gaussians``, which are in this one's world."""
    moved = GaussianMap()
    moved.append(gaussians)
    move_gaussians(moved, {0: T_mb.inverse()})
    return BaseGaussians(moved.parameters)


def seen(gaussians: GaussianMap, keyframe: int = 5) -> View:
    view = view_of(picture(gaussians, Sim3.identity()))
    view.keyframe = keyframe
    return view


def test_those_on_the_surface_that_a_keyframe_shows_become_its_own() -> None:
    mapper, ground = Mapper(nothing_new(), renderer(), 0), floor()
    mapper.insert(seen(ground), flat_pointmap(), [(earlier(ground), T_MB)])
    assert 100 < len(mapper.gaussians) < len(ground), "those inside the picture"
    assert mapper.gaussians.keyframes.unique().tolist() == [5]
    assert len(mapper.optimiser.adam.steps) == len(mapper.gaussians)
    apart = torch.cdist(mapper.gaussians.means, ground.means).amin(dim=1)
    assert float(apart.max()) < 1e-3
    assert torch.allclose(mapper.gaussians.scales, ground.scales[:1], rtol=1e-4)


def test_what_was_moved_away_since_does_not_come() -> None:
    ground = floor()
    block = gaussians_at(torch.tensor([[0.1, 0.1, 1.5]]), torch.ones(1, 3), 0.1)
    before = GaussianMap()
    before.append(ground)
    before.append(block)
    base, mapper = earlier(before), Mapper(nothing_new(), renderer(), 0)
    mapper.insert(seen(ground), flat_pointmap(), [(base, T_MB)])
    assert float(mapper.gaussians.means[:, 2].min()) > FLOOR_M - 0.01
    assert base.waiting[-1]


def test_a_damaged_gaussian_does_not_keep_the_others_from_coming() -> None:
    ground = floor()
    base = {name: tensor.clone() for name, tensor in ground.parameters.items()}
    base["log_scales"][150] = torch.nan
    mapper = Mapper(nothing_new(), renderer(), 0)
    mapper.insert(seen(ground), flat_pointmap(), [(BaseGaussians(base), Sim3.identity())])
    assert len(mapper.gaussians) > 100


def test_what_something_new_hides_waits() -> None:
    base, mapper = earlier(floor()), Mapper(nothing_new(), renderer(), 0)
    mapper.insert(seen(floor()), flat_pointmap(1.2), [(base, T_MB)])
    assert len(mapper.gaussians) == 0
    assert base.waiting.all()


def test_nothing_comes_where_no_range_is_known_or_the_vehicle_is() -> None:
    view, pointmap = seen(floor()), flat_pointmap()
    pointmap.rho[:, :32] = 0.0
    view.mask = np.ones((48, 64), bool)
    view.mask[:24] = False
    mapper = Mapper(nothing_new(), renderer(), 0)
    mapper.insert(view, pointmap, [(earlier(floor()), T_MB)])
    at = view.camera.project(mapper.gaussians.means.numpy())
    assert len(at) > 20
    assert at[:, 0].min() > 30.0, "two pixels of a known range"
    assert at[:, 1].min() > 22.0


def test_what_the_map_has_already_does_not_come_twice() -> None:
    mapper, base = grown(settings(insertion={"bare_probability": 1.0})), earlier(floor())
    mapper.insert(seen(floor()), flat_pointmap(), [(base, T_MB)])
    assert base.taken < 10
    assert base.waiting.sum() < 200, "what the picture shows does not wait any more"


def test_nothing_is_inserted_over_what_came() -> None:
    config, ground = settings(insertion={"density": 1.0, "bare_probability": 1.0}), floor()
    alone, helped = Mapper(config, renderer(), 0), Mapper(config, renderer(), 0)
    without = alone.insert(seen(ground), flat_pointmap())
    assert helped.insert(seen(ground), flat_pointmap(), [(earlier(ground), T_MB)]) < 0.1 * without


def test_they_come_in_the_light_of_this_dive() -> None:
    ground, gain = floor(), torch.tensor([0.5, 0.8, 0.7])
    mapper = Mapper(nothing_new(), renderer(), 0)
    dim = gaussians_at(ground.means, ground.colours * gain, 0.09)
    view = seen(dim)
    mapper.add_view(view)
    mapper.insert(view, flat_pointmap(), [(earlier(ground), T_MB)])
    error = (mapper.show(view).image - view.target()).abs().mean()
    in_old_light = (seen(ground).target() - view.target()).abs().mean()
    assert float(error) < 0.35 * float(in_old_light)


def test_a_map_takes_no_more_than_it_has_room_for() -> None:
    ground = floor(columns=60, rows=45, scale=0.03)
    mapper = Mapper(nothing_new(max_gaussians=1000), renderer(), 0)
    base = earlier(ground)
    mapper.insert(seen(ground), flat_pointmap(), [(base, T_MB)])
    assert len(mapper.gaussians) == base.taken == 1000
    assert (~base.waiting).sum() == 1000


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A map file of the floor."""
    mapper = grown(settings())
    write_facts_file(tmp_path / "map.aqf", *serialise(mapper))
    return tmp_path / "map.aqf"


def growth(index: int, file: Path) -> Growth:
    view = filmed(floor(), [pose((0.3 * index, 0.0, 0.0))])[0]
    view = View(index, view.image, view.camera, view.T_wc, index, robust=False)
    return Growth(view, 0, 0, flat_pointmap(), base={file: Sim3.identity()})


def test_a_dive_that_goes_on_takes_nothing_a_second_time(file: Path) -> None:
    config = Config(mapping=nothing_new())
    maps, resumed = Maps(config), Maps(config)
    maps.grow(growth(0, file))
    assert maps.taken_over == len(maps.mappers[0].gaussians) > 100
    facts, arrays = maps.serialise()
    resumed.restore(facts, arrays)
    assert resumed.taken_over == maps.taken_over
    for each in (maps, resumed):
        each.mappers[0].optimiser.keep(torch.zeros(maps.taken_over, dtype=torch.bool))
        each.grow(growth(1, file))
        assert len(each.mappers[0].gaussians) < 100
    assert resumed.taken_over == maps.taken_over


@pytest.mark.usefixtures("contained")
def test_a_map_file_that_cannot_be_read_is_counted_once(tmp_path: Path) -> None:
    (tmp_path / "map.aqf").write_bytes(b"no map")
    failures = Failures()
    maps = BaseMaps(failures)
    for _ in range(2):
        ((gaussians, _),) = maps.placed({tmp_path / "map.aqf": T_MB})
        assert len(gaussians.waiting) == 0
    assert [each["count"] for each in failures.to_json()] == [1]


def test_colours_are_taken_over_as_they_are_where_too_few_can_be_compared() -> None:
    ground = gaussians_at(torch.tensor([[0.0, 0.0, FLOOR_M]]), torch.full((1, 3), 0.4), 0.3)
    mapper = Mapper(nothing_new(), renderer(), 0)
    view = view_of(np.full((48, 64, 3), 200, np.uint8))
    mapper.insert(view, flat_pointmap(), [(earlier(ground), T_MB)])
    expected = raw_colour(torch.full((1, 3), 0.4))
    assert torch.allclose(mapper.gaussians.parameters["raw_colours"], expected, atol=1e-4)
