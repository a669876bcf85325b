"""Deliverables while the dive goes on: when they are written, and what they may cost."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.service import LiveMappingConfig
from aquaflow.live import deliverable_updates as module
from aquaflow.live.deliverable_updates import SHARE, DeliverableUpdater
from aquaflow.live.health.heartbeats import Heartbeats
from aquaflow.live.map_thread import MapThread
from tests.live.live_scenes import Clock, RecordedMaps

EVERY_S = 60.0


class Scene:
    """A refresher whose files, clock and CPU time the test holds."""

    def __init__(self) -> None:
        self.maps, self.clock, self.cpu = RecordedMaps(), Clock(), Clock()
        self.maps.mappers[0] = SimpleNamespace(gaussians=[])  # type: ignore[assignment]
        self.thread = MapThread(self.maps, LiveMappingConfig(nice=0), Heartbeats())
        self.frames, self.wrote, self.part_s = [0] * 3, list[str](), 0.1
        self.fails: Callable[[], None] = lambda: None
        run: Any = SimpleNamespace(
            slam=SimpleNamespace(frames=self.frames), check_calibration=self.check_calibration
        )
        self.check: Callable[[], None] = lambda: None
        self.refresher = DeliverableUpdater(run, self.thread, EVERY_S, self.clock, self.cpu)

    def check_calibration(self) -> None:
        self.check()

    def wrote_part(self, name: str) -> None:
        self.wrote.append(name)
        self.cpu.pass_(self.part_s)
        self.fails()

    def after(self, seconds: float) -> list[str]:
        """What is written when so much time has passed."""
        self.wrote.clear()
        self.clock.pass_(seconds)
        self.refresher.write_if_due(disk_is_full=False)
        for _ in range(5):  # each part is posted by the one before
            self.caught_up()
        return list(self.wrote)

    def caught_up(self) -> None:
        done = threading.Event()
        self.thread.later("wait", lambda maps: done.set())
        assert done.wait(60.0)


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    scene = Scene()

    class Told:
        def __init__(self, run: object) -> None: ...

        def write_maps(self, _: object) -> None:
            scene.wrote_part("maps")

        def write_path(self) -> None:
            scene.wrote_part("path")

        def write_report(self, _: object) -> None:
            scene.wrote_part("report")

    monkeypatch.setattr(module, "Interim", Told)
    yield scene
    scene.thread.close()


ALL = ["maps", "path", "report"]


def test_they_are_written_once_in_every_period(scene: Scene) -> None:
    assert scene.after(EVERY_S - 1.0) == []
    assert scene.after(2.0) == ALL
    assert scene.after(EVERY_S - 2.0) == []
    assert scene.after(3.0) == ALL
    assert scene.refresher.to_json() == {"written": 2, "age_s": 0.0, "cpu_s": 0.3}


def test_what_they_cost_bounds_how_often_they_are_written(scene: Scene) -> None:
    scene.part_s = 1.0
    assert scene.after(EVERY_S) == ALL
    assert scene.after(EVERY_S) == []
    assert scene.after(3.0 / SHARE - EVERY_S) == ALL
    scene.part_s = 0.1
    assert scene.after(3.0 / SHARE) == ALL
    assert scene.after(EVERY_S) == ALL


def test_without_a_map_or_room_or_after_the_end_nothing_is_written(scene: Scene) -> None:
    scene.refresher.write_soon()
    scene.refresher.write_if_due(disk_is_full=True)
    scene.caught_up()
    assert scene.wrote == []
    scene.frames.pop()
    assert scene.after(0.0) == []
    scene.frames.append(0)
    mappers = dict(scene.maps.mappers)
    scene.maps.mappers.clear()
    assert scene.after(0.0) == []
    scene.maps.mappers.update(mappers)
    assert scene.after(0.0) == ALL
    scene.refresher.end()
    assert scene.after(10.0 * EVERY_S) == []


def test_mapping_goes_on_between_the_parts(scene: Scene) -> None:
    held, order = threading.Event(), scene.wrote
    scene.thread.later("hold", lambda maps: held.wait(60.0) and None)
    scene.clock.pass_(EVERY_S)
    scene.refresher.write_if_due(disk_is_full=False)
    scene.thread.later("map", lambda maps: order.append("mapping"))
    held.set()
    for _ in range(4):
        scene.caught_up()
    assert order == ["maps", "mapping", "path", "report"]


def test_an_end_in_their_midst_leaves_the_other_parts_to_it(scene: Scene) -> None:
    scene.fails = scene.refresher.end
    assert scene.after(EVERY_S) == ["maps"]


def test_a_part_that_fails_or_finds_no_room_costs_itself(scene: Scene) -> None:
    def full() -> None:
        raise InputError("cannot write map.ply") from OSError(errno.ENOSPC, "no room")

    def broken() -> None:
        raise ArithmeticError("the water's summary is not finite")

    scene.maps.failures.strict = False
    for fails in (full, broken):
        scene.fails = fails
        assert scene.after(EVERY_S) == ALL
    assert scene.thread.failures == 0  # mapping itself is well
    assert [kind.stage for kind in scene.maps.failures.kinds] == [
        "write the maps", "write the path", "write the report",
    ]  # fmt: skip
    assert not scene.maps.failures.disk_was_full


def test_the_calibration_is_checked_before_each_report(scene: Scene) -> None:
    scene.check = lambda: scene.wrote_part("calibration")
    assert scene.after(EVERY_S) == ["maps", "path", "calibration", "report"]
