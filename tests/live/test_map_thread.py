"""Mapping beside tracking: order, what is left out when it is behind, what a failure costs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.worker import Lateness
from aquaflow.config.service import LiveMappingConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.heartbeats import Heartbeats
from aquaflow.live.map_thread import STAGE, MapThread
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.work import Growth, Insertion
from aquaflow.render.views import View
from tests.live.live_scenes import HEIGHT, WIDTH, RecordedMaps

CAMERA = guess_camera(WIDTH, HEIGHT)


class Beside:
    """A mapping thread that can be held up."""

    def __init__(self) -> None:
        self.maps, self.heartbeats, self.level = RecordedMaps(), Heartbeats(), DegradationLevel.FULL
        self.lateness = Lateness()
        config = LiveMappingConfig(backlog=2, nice=0)
        self.thread = MapThread(
            self.maps, config, self.heartbeats, lambda: self.level, self.lateness
        )

    def hold(self) -> threading.Event:
        """Let the thread do nothing until the event is set."""
        held, going = threading.Event(), threading.Event()

        def wait(maps: object, lacking: object) -> None:
            going.set()
            held.wait(20.0)

        self.thread.inspect("wait", wait)
        assert going.wait(20.0)
        return held


@pytest.fixture
def beside() -> Iterator[Beside]:
    beside = Beside()
    yield beside
    beside.thread.close()


def growth(index: int, robust: bool = False, retired: tuple[Insertion, ...] = ()) -> Growth:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = View(index, image, CAMERA, Sim3.identity(), 0, robust)
    return Growth(view, 0, 8, None if robust else Pointmap.unknown(CAMERA), retired)


def test_requests_are_done_in_their_order(beside: Beside) -> None:
    for index in range(2):
        beside.thread.grow(growth(index))
    beside.thread.close()
    assert beside.maps.asked == ["grow 0 64px 8", "grow 1 64px 8"]


def test_common_frames_beyond_the_backlog_come_as_views_without_steps(beside: Beside) -> None:
    held = beside.hold()
    for index in range(4):
        beside.thread.grow(growth(index, robust=True))
    held.set()
    beside.thread.close()
    assert beside.maps.asked == [
        "grow 0 64px 8", "grow 1 64px 8", "grow 2 64px 0", "grow 3 64px 0",
    ]  # fmt: skip
    assert beside.thread.without_steps == 2
    assert not beside.thread.left_out


def test_common_frames_are_left_out_first_and_counted(beside: Beside) -> None:
    held = beside.hold()
    for index in range(20):
        beside.thread.grow(growth(index, robust=True))
    for index in range(20, 30):
        beside.thread.grow(growth(index))
    held.set()
    beside.thread.close()
    left_out = beside.thread.left_out
    assert left_out["common frame, mapping was behind"] == 4
    assert left_out["mapping frame, mapping was behind"] == 6
    assert len(beside.maps.asked) == 20


def test_a_keyframe_that_the_map_never_saw_does_not_retire_into_it(beside: Beside) -> None:
    seen, unseen = growth(0), growth(1)
    beside.thread.grow(seen)
    retired = tuple(Insertion(g.view, 0, Pointmap.unknown(CAMERA)) for g in (seen, unseen))
    beside.thread.grow(growth(2, retired=retired))
    beside.thread.close()
    assert beside.maps.asked == ["grow 0 64px 8", "grow 2 64px 8", "insert 0"]


@pytest.mark.parametrize(
    ("level", "asked"),
    [
        (DegradationLevel.FEWER_STEPS, ["grow 0 64px 2"]),
        (DegradationLevel.SMALLER_IMAGES, ["grow 0 32px 2"]),
        (DegradationLevel.TRACKING_ONLY, []),
    ],
)
def test_each_level_asks_for_less(
    beside: Beside, level: DegradationLevel, asked: list[str]
) -> None:
    beside.level = level
    beside.thread.grow(growth(0))
    beside.thread.close()
    assert beside.maps.asked == asked


def test_a_lost_gpu_costs_its_requests_and_is_told(beside: Beside) -> None:
    beside.maps.fail = True
    beside.thread.grow(growth(0))
    assert beside.maps.failed.wait(20.0)
    beside.hold().set()
    assert beside.thread.failures == 1
    assert "the GPU is gone" in beside.thread.last_failure
    beside.maps.fail = False
    beside.thread.grow(growth(1))
    beside.thread.close()
    assert beside.maps.asked == ["grow 1 64px 8"]


class StubMapper:
    """Has had steps enough, but of views that were let go of since."""

    def __init__(self, views: list[View]) -> None:
        self.gaussians, self.steps, self.views = [0], 1_000_000, views
        self.done = threading.Event()

    def optimise(self, steps: int) -> None:
        self.views[-1].looks += steps
        if self.views[-1].looks >= len(self.views) * LiveMappingConfig().steps_per_view:
            self.done.set()


def test_idle_steps_go_on_until_the_views_that_are_kept_have_had_theirs(
    beside: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mapper, "optimise", StubMapper.optimise)
    mapper = StubMapper([growth(index).view for index in range(3)])
    beside.maps.mappers[0] = mapper  # type: ignore[assignment]
    beside.thread.grow(growth(9))
    assert mapper.done.wait(20.0)
    beside.thread.close()
    assert mapper.views[-1].looks == 3 * LiveMappingConfig().steps_per_view


def test_idle_steps_wait_until_tracking_is_in_time(
    beside: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mapper, "optimise", StubMapper.optimise)
    mapper = StubMapper([growth(index).view for index in range(3)])
    beside.maps.mappers[0] = mapper  # type: ignore[assignment]
    beside.lateness.times = 1.5
    beside.thread.grow(growth(9))
    assert not mapper.done.wait(0.5)
    beside.lateness.times = 0.5
    assert mapper.done.wait(20.0)


def test_mapping_rests_while_tracking_is_late_and_goes_on_once_it_is_not(beside: Beside) -> None:
    beside.hold().set()
    beside.hold().set()
    assert beside.lateness.rests == 0
    beside.lateness.times = 1e6
    beside.hold().set()
    done = threading.Event()
    beside.thread.later("work", lambda maps: done.set())
    assert not done.wait(0.3)
    beside.lateness.times = 1.0
    assert done.wait(20.0)
    assert beside.lateness.rests >= 1


def test_a_checkpoint_does_not_wait_until_a_rest_ends(beside: Beside) -> None:
    held, worked, done = beside.hold(), threading.Event(), threading.Event()
    beside.lateness.times = 1e6
    held.set()
    while not beside.lateness.rests:
        time.sleep(0.01)
    beside.thread.later("work", lambda maps: worked.set())
    beside.thread.inspect("write", lambda maps, lacking: done.set())
    assert done.wait(2.0)
    assert not worked.is_set()


def test_a_refinement_that_fails_leaves_the_map_as_it_is(
    beside: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refine(*_: object) -> None:
        raise RuntimeError("told so")

    monkeypatch.setattr(beside.maps, "refine", refine)
    beside.thread.refine()
    assert beside.thread.failures == 1
    assert beside.thread.last_failure == "refine: told so"


def test_frames_that_wait_when_a_dives_time_is_up_are_left_out_and_corrections_made(
    beside: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(beside.maps, "correct", lambda *_: beside.maps.asked.append("correct"))
    held = beside.hold()
    beside.thread.grow(growth(0))
    beside.thread.correct({3: Sim3.identity()}, {})
    ending = threading.Thread(target=beside.thread.refine, kwargs={"until": Deadline(0.0)})
    ending.start()
    assert beside.thread._ending.wait(20.0)
    held.set()
    ending.join()
    assert beside.maps.asked == ["correct"]
    assert beside.thread.left_out == {"the dive ended before mapping had caught up": 1}


def test_a_look_is_told_the_corrections_that_still_wait(beside: Beside) -> None:
    held, told = beside.hold(), []
    beside.thread.correct({3: Sim3.identity()}, {1: 0})
    beside.thread.inspect("look", lambda maps, lacking: told.append(lacking))
    held.set()
    beside.thread.close()
    ((correction,),) = told
    assert (list(correction.moves), dict(correction.merged)) == ([3], {1: 0})


def test_an_idle_thread_shows_that_it_lives_and_a_closed_one_is_not_missed(
    beside: Beside,
) -> None:
    beside.hold().set()
    assert beside.heartbeats.ages_s()[STAGE] < 20.0
    beside.thread.close()
    assert STAGE not in beside.heartbeats.ages_s()
