"""A device whose memory is full costs the step or the insertion that found it so, and no more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.mapping.device_work import MOST_LEFT_OUT
from aquaflow.mapping.mapper import MOST_FULL
from aquaflow.render.gsplat import usable_share
from tests.device.failing_dives import (
    VIEWS,
    assert_goes_on,
    assert_goes_on_on_the_cpu,
    dive,
    growth,
    state_of,
)
from tests.pretended_allocator import DEFAULT_BYTES
from tests.pretended_device import PRETENDED, Device

pytestmark = [pytest.mark.usefixtures("nothing_strays", "repaired"), pytest.mark.ci]

ROOM = 8000
"""Bytes, in which the map can be looked after but not drawn."""


def fill(device: Device, room: int) -> None:
    """Leave ``room`` bytes for new tensors."""
    device.memory.total = device.memory.allocated + room


def test_a_step_that_finds_no_memory_is_left_out_and_the_next_is_made(device: Device) -> None:
    maps = dive()
    before, steps = state_of(maps), maps.mappers[0].steps
    device.fails_at = device.calls + 40  # within the drawing of the first step
    maps.optimise(0, 3)
    assert maps.mappers[0].steps == steps + 2
    assert maps.failures.device_full == 1
    after = state_of(maps)
    assert int(after["adam.steps"].max()) == int(before["adam.steps"].max()) + 2
    assert device.memory.emptied > 0
    assert_goes_on(maps, PRETENDED, VIEWS)


def test_steps_that_all_find_no_memory_end_the_round_and_leave_the_map_as_it_was(
    device: Device,
) -> None:
    maps = dive()
    before = state_of(maps)
    fill(device, ROOM)
    maps.optimise(0, 20)
    assert device.memory.refused == MOST_FULL
    device.memory.total = DEFAULT_BYTES
    after = state_of(maps)
    for name, array in before.items():
        if not name.startswith("random"):
            np.testing.assert_array_equal(after[name], array, err_msg=name)
    assert_goes_on(maps, PRETENDED, VIEWS)


def test_an_insertion_that_finds_no_memory_is_left_out(device: Device) -> None:
    maps = dive(views=2)
    count = len(maps.mappers[0].gaussians)
    fill(device, ROOM)
    maps.grow(growth(2, steps=0))
    assert device.memory.refused > 0
    assert len(maps.mappers[0].gaussians) == count
    device.memory.total = DEFAULT_BYTES
    assert_goes_on(maps, PRETENDED, 3)


@pytest.mark.parametrize("call", [400, 700, 1000])
def test_wherever_memory_lacks_while_a_decoded_map_grows_it_stays_whole(
    device: Device, call: int
) -> None:
    maps = dive(decoder=True, views=2)
    device.fails_at = device.calls + call
    maps.grow(growth(2))
    assert maps.failures.device_full == 1
    assert_goes_on(maps, PRETENDED, 3)


def test_rows_that_an_insertion_could_not_add_begin_anew_and_the_others_are_kept(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = dive(views=2)
    mapper, before = maps.mappers[0], state_of(maps)
    adam, extend = mapper.optimiser.adam, mapper.optimiser.adam.extend

    def without_memory(count: int) -> None:
        monkeypatch.setattr(adam, "extend", extend)
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB.")

    monkeypatch.setattr(adam, "extend", without_memory)
    maps.grow(growth(2, steps=0))
    added = len(mapper.gaussians) - len(before["adam.steps"])
    assert added > 0
    after = state_of(maps)
    assert not after["adam.steps"][-added:].any()
    for name in ("adam.steps", "adam.first.means", "adam.second.quats"):
        np.testing.assert_array_equal(after[name][:-added], before[name])
    assert_goes_on(maps, PRETENDED, 3)


def test_a_map_that_is_too_large_for_its_device_goes_on_on_the_cpu(device: Device) -> None:
    maps = dive()
    fill(device, ROOM)
    for _ in range(MOST_LEFT_OUT):
        maps.optimise(0, MOST_FULL)
        assert maps.renderer.device == PRETENDED
    steps = maps.mappers[0].steps
    maps.optimise(0, 1)
    assert maps.mappers[0].steps == steps + 1
    assert_goes_on_on_the_cpu(maps)


def test_the_refinement_leaves_out_single_steps(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = dive()
    optimiser, steps = maps.mappers[0].optimiser, maps.mappers[0].steps
    step = optimiser.step

    def step_that_fails_once(*given: Any) -> None:
        if optimiser.steps == steps + 2 and device.fails_at is None:
            device.fails_at = device.calls + 40
        step(*given)

    monkeypatch.setattr(optimiser, "step", step_that_fails_once)
    maps.refine()
    assert maps.failures.device_full == 1
    assert maps.renderer.device == PRETENDED
    assert maps.mappers[0].steps == steps + maps.config.mapping.optimiser.refine_steps - 1


def test_a_refinement_without_memory_is_made_on_the_cpu(device: Device) -> None:
    maps = dive()
    steps = maps.mappers[0].steps
    fill(device, ROOM)
    maps.refine()
    assert maps.mappers[0].steps == steps + maps.config.mapping.optimiser.refine_steps
    assert_goes_on_on_the_cpu(maps)


def test_idle_blocks_count_as_memory_that_is_left(device: Device) -> None:
    maps = dive()
    maps.optimise(0, 1)
    memory = device.memory
    memory.total = 2 * memory.reserved
    assert memory.reserved > memory.allocated
    share = usable_share(PRETENDED)
    assert share == pytest.approx((memory.total - memory.allocated) / memory.total)
    memory.empty_cache()
    assert usable_share(PRETENDED) == pytest.approx(share)


def test_memory_given_back_is_the_drivers_and_copies_of_pictures_are_made_anew(
    device: Device,
) -> None:
    maps = dive()
    maps.grow(growth(VIEWS))
    before = device.memory.allocated
    maps.give_back_memory()
    assert device.memory.reserved == device.memory.allocated < before
    copied = device.moved_in
    maps.mappers[0].views[-1].target()
    assert device.moved_in == copied + 1
