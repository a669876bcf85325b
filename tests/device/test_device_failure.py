"""A device that fails in mid-dive costs neither map nor optimiser: both go on on the CPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.mapping.device_work import COPY_EVERY
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.work import Growth
from aquaflow.render.contract import CPU
from tests.device.failing_dives import (
    SHIFT,
    assert_goes_on_on_the_cpu,
    dive,
    growth,
    state_of,
)
from tests.pretended_device import PRETENDED, Device

pytestmark = [pytest.mark.usefixtures("nothing_strays", "repaired"), pytest.mark.ci]


@pytest.mark.parametrize("decoder", [False, True])
def test_a_device_that_is_gone_leaves_the_last_copy_of_map_and_optimiser(
    device: Device, decoder: bool
) -> None:
    maps = dive(decoder)
    copied = state_of(maps)
    maps.optimise(0, 1)
    device.fails_at, device.lost = device.calls + 1, True
    maps.optimise(0, 0 if decoder else 1)
    if decoder:
        maps.optimise(0, 1)
    after = state_of(maps)
    assert after["gaussians.means"].shape == copied["gaussians.means"].shape
    assert int(after["adam.steps"].max()) == int(copied["adam.steps"].max()) + 1
    np.testing.assert_allclose(after["gaussians.means"], copied["gaussians.means"], atol=0.02)
    assert_goes_on_on_the_cpu(maps)


def test_a_copy_is_taken_now_and_then_as_the_map_grows(device: Device) -> None:
    maps = dive(views=2)
    size = len(state_of(maps))
    copies = []
    for number in range(2, 2 + COPY_EVERY + 2):
        moved = device.moved_out
        maps.grow(replace(growth(number, steps=0), pointmap=None))
        copies.append(device.moved_out - moved > size // 2)
    assert copies == [True, *[False] * (COPY_EVERY - 1), True, False]


def test_corrections_since_the_copy_are_made_in_it_too(device: Device) -> None:
    maps = dive(decoder=True, views=3)
    before = state_of(maps)
    for _ in range(2):
        maps.correct(SHIFT, {})
    device.fails_at, device.lost = device.calls + 1, True
    maps.optimise(0, 1)
    after = state_of(maps)
    shift = np.median(after["gaussians.means"] - before["gaussians.means"], axis=0)
    np.testing.assert_allclose(shift, [1.0, 0.0, 0.0], atol=0.01)
    assert_goes_on_on_the_cpu(maps, 3)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("call", [1, 20, 40])
def test_a_failure_within_a_correction_moves_the_map_exactly_once(
    device: Device, lost: bool, call: int
) -> None:
    maps = dive(decoder=True, views=3)
    before = state_of(maps)
    device.fails_at, device.lost = device.calls + call, lost
    maps.correct(SHIFT, {})
    after = state_of(maps)
    shift = after["gaussians.means"] - before["gaussians.means"]
    np.testing.assert_allclose(shift, np.broadcast_to([0.5, 0.0, 0.0], shift.shape), atol=1e-5)
    poses = after["views.poses"][:, 9:12] - before["views.poses"][:, 9:12]
    np.testing.assert_allclose(poses, np.broadcast_to([0.5, 0.0, 0.0], poses.shape), atol=1e-9)
    assert_goes_on_on_the_cpu(maps, 3)


@pytest.mark.parametrize("call", [3, 400, 1000])
def test_wherever_the_device_is_lost_while_the_map_grows_the_view_is_in_it_once(
    device: Device, call: int
) -> None:
    maps = dive(decoder=True, views=2)
    device.fails_at, device.lost = device.calls + call, True
    maps.grow(growth(2))
    assert_goes_on_on_the_cpu(maps, 3)
    assert len(maps.mappers[0].gaussians) > 0


def test_the_refinement_is_made_on_the_cpu_if_the_device_fails_in_it(device: Device) -> None:
    maps = dive()
    before = maps.mappers[0].steps
    device.fails_at, device.lost = device.calls + 900, True
    maps.refine()
    assert device.calls >= device.fails_at
    assert maps.renderer.device == CPU
    assert maps.mappers[0].steps >= before
    assert maps.mappers[0].views[0].looks > 0


def test_maps_merge_even_if_the_device_fails_in_it(device: Device) -> None:
    maps = dive(views=2)
    other = growth(10)
    maps.grow(Growth(other.view, 1, 1, other.pointmap))
    count = sum(len(mapper.gaussians) for mapper in maps.mappers.values())
    device.fails_at, device.lost = device.calls + 20, True
    maps.correct({}, {1: 0})
    assert maps.renderer.device == CPU
    assert list(maps.mappers) == [0]
    assert [view.frame_index for view in maps.mappers[0].views] == [0, 1, 10]
    assert len(maps.mappers[0].gaussians) == count


def test_another_error_leaves_the_map_on_its_device(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = dive(views=2)

    def broken(*_: object) -> None:
        raise ValueError("no such pixel")

    monkeypatch.setattr(Mapper, "insert", broken)
    maps.grow(growth(2))
    assert maps.renderer.device == PRETENDED
    assert maps.failures.total == 1
