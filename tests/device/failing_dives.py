"""Maps on the pretended device, as they are when it fails."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.neural.neural import is_whole
from aquaflow.mapping.state import serialise
from aquaflow.mapping.work import Growth
from aquaflow.render.contract import CPU
from tests.device.device_scenes import SMALL, SinglePrecision, again, everything
from tests.mapping.mapping_scenes import flat_pointmap, floor, path, picture, pose, view_of
from tests.pretended_device import PRETENDED

VIEWS = 4
GROWN: dict[tuple[bool, int], Maps] = {}
"""Maps by decoder and number of views, of which every test gets a copy."""
SHIFT = {0: pose((0.5, 0.0, 0.0))}
"""A correction that moves the whole map."""


def growth(number: int, steps: int = 2) -> Growth:
    T_wc = path(number + 1)[number]
    view = view_of(picture(floor(), T_wc, camera=SMALL), T_wc, number, camera=SMALL)
    pointmap = flat_pointmap(camera=SMALL) if number % 2 == 0 else None
    return Growth(view, 0, steps, pointmap)


def dive(decoder: bool = False, views: int = VIEWS) -> Maps:
    """Maps on the device after some views, of which there is a copy on the host."""
    if (decoder, views) not in GROWN:
        GROWN[decoder, views] = _grown(decoder, views)
    return copy_of(GROWN[decoder, views])


def copy_of(whole: Maps) -> Maps:
    """The same on the device, with a copy on the host."""
    maps = Maps(whole.config, SinglePrecision(PRETENDED), failures=Failures(strict=False))
    maps.mappers[0] = again(whole.mappers[0], PRETENDED)
    maps.mappers[0].failures = maps.mappers[0].water_fitting.failures = maps.failures
    maps._work.copy(0)
    return maps


def _grown(decoder: bool, views: int) -> Maps:
    mapping = everything(medium={"enabled": False}, decoder={"enabled": decoder})
    config = Config(mapping=mapping, threads=1)
    maps = Maps(config, SinglePrecision(PRETENDED), failures=Failures(strict=False))
    for number in range(views):
        maps.grow(growth(number))
    assert maps.renderer.device == PRETENDED
    return maps


def state_of(maps: Maps) -> dict[str, np.ndarray]:
    """All arrays of the map and its optimiser, on the host."""
    return serialise(maps.mappers[0], optimiser=True)[1]


def assert_goes_on(maps: Maps, where: torch.device, views: int) -> None:
    """The map is whole, on that device, and grows by another view."""
    mapper = maps.mappers[0]
    assert maps.renderer.device == mapper.device == where
    assert {view.device for view in mapper.views} == {where}
    assert {tensor.device for tensor in mapper.gaussians.parameters.values()} == {where}
    assert [view.frame_index for view in mapper.views] == list(range(views))
    assert all(view.has_pixels for view in mapper.views)
    assert len(maps.failures.kinds) >= 1
    before, looks = mapper.steps, len(mapper.views)
    maps.grow(growth(views))
    assert mapper.steps == before + 2
    assert len(mapper.views) == looks + 1
    assert all(bool(torch.isfinite(each).all()) for each in mapper.gaussians.parameters.values())
    assert len(mapper.optimiser.adam.steps) == len(mapper.gaussians)
    if mapper.neural is not None:
        assert is_whole(mapper.neural.groups, len(mapper.gaussians))


def assert_goes_on_on_the_cpu(maps: Maps, views: int = VIEWS) -> None:
    assert_goes_on(maps, CPU, views)
