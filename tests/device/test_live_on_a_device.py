"""The mapping thread of a live run works on a device, and goes on where the device fails."""

from __future__ import annotations

import threading

import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.config.service import LiveMappingConfig
from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.heartbeats import Heartbeats
from aquaflow.live.map_thread import MapThread
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.state import MapCopy, copy_map
from aquaflow.mapping.work import Growth
from aquaflow.render.contract import CPU
from tests.device.device_scenes import SMALL, SinglePrecision, everything
from tests.mapping.mapping_scenes import flat_pointmap, floor, path, picture, view_of
from tests.pretended_allocator import DEFAULT_BYTES
from tests.pretended_device import PRETENDED, Device

pytestmark = pytest.mark.usefixtures("nothing_strays", "repaired")

GIVE_UP_S = 300.0


def growth(number: int) -> Growth:
    T_wc = path(number + 1)[number]
    view = view_of(picture(floor(), T_wc, camera=SMALL), T_wc, number, camera=SMALL)
    return Growth(view, 0, 1, flat_pointmap(camera=SMALL) if number == 0 else None)


class Level:
    """The level of the service, as the test says."""

    def __init__(self) -> None:
        self.now = DegradationLevel.FULL

    def __call__(self) -> DegradationLevel:
        return self.now


def thread_on_the_device(level: Level | None = None) -> MapThread:
    mapping = everything(medium={"enabled": False}, decoder={"enabled": False})
    maps = Maps(
        Config(mapping=mapping, threads=1), SinglePrecision(PRETENDED),
        failures=Failures(strict=False),
    )  # fmt: skip
    config = LiveMappingConfig.model_validate({"backlog": 100, "steps_per_view": 0, "nice": 0})
    return MapThread(maps, config, Heartbeats(), level or Level())


def looked_at(thread: MapThread) -> MapCopy:
    """What a live viewer gets, once all that was asked for is done."""
    copies: list[MapCopy] = []
    done = threading.Event()

    def look(maps: Maps) -> None:
        copies.append(copy_map(maps.mappers[0]))
        done.set()

    thread._post("look", look)
    assert done.wait(GIVE_UP_S)
    return copies[0]


def said_after(thread: MapThread) -> tuple[bool, str]:
    """Whether the last request failed, and of what."""
    said: list[tuple[bool, str]] = []
    done = threading.Event()

    def look(maps: Maps) -> None:
        said.append((thread.failing, thread.last_failure))
        done.set()

    thread._post("look", look)
    assert done.wait(GIVE_UP_S)
    return said[0]


def test_a_live_map_grows_on_the_device_and_is_shown_from_there(device: Device) -> None:
    thread = thread_on_the_device()
    for number in range(3):
        thread.grow(growth(number))
    copy = looked_at(thread)
    thread.close()
    assert thread.renderer.device == PRETENDED
    assert thread.failures == 0
    assert len(copy.clear) == len(thread.mappers[0].gaussians) > 0


def test_a_live_map_goes_on_when_its_device_is_lost(device: Device) -> None:
    thread = thread_on_the_device()
    for number in range(2):
        thread.grow(growth(number))
    before = looked_at(thread)
    device.fails_at, device.lost = device.calls + 100, True
    for number in range(2, 4):
        thread.grow(growth(number))
    after = looked_at(thread)
    thread.close()
    device.fails_at, device.lost = None, False
    assert thread.renderer.device == CPU
    assert not thread.failing
    assert len(thread.mappers[0].views) == 4
    assert len(after.clear) == len(before.clear) > 0


def test_a_full_device_costs_a_live_map_what_it_was_asked_for_meanwhile(device: Device) -> None:
    thread = thread_on_the_device()
    for number in range(2):
        thread.grow(growth(number))
    before = looked_at(thread)
    device.memory.total = device.memory.allocated + 8000
    thread.grow(growth(2))
    assert said_after(thread) == (True, "grow: the GPU's memory was full")
    device.memory.total = DEFAULT_BYTES
    thread.grow(growth(3))
    after = looked_at(thread)
    assert not said_after(thread)[0]
    thread.close()
    assert thread.renderer.device == PRETENDED
    assert [view.frame_index for view in thread.mappers[0].views] == [0, 1, 2, 3]
    assert len(after.clear) == len(before.clear) > 0


def test_at_each_step_down_memory_is_given_back(device: Device) -> None:
    level = Level()
    thread = thread_on_the_device(level)
    thread.grow(growth(0))
    looked_at(thread)
    emptied, taken = device.memory.emptied, device.memory.allocated
    for level.now in (DegradationLevel.FEWER_STEPS, DegradationLevel.SMALLER_IMAGES):
        looked_at(thread)
    looked_at(thread)
    thread.close()
    assert device.memory.emptied == emptied + 2
    assert device.memory.allocated < taken
