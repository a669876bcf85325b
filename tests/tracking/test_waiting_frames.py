"""Whatever happens to tracking: every frame that it is given leaves it once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding, PairGeometry
from aquaflow.tracking import map_start
from aquaflow.tracking.current_keyframe import CurrentKeyframe
from aquaflow.tracking.frames import (
    BOUNDS,
    Bound,
    FrameClass,
    Quality,
    Tracked,
    Wait,
    WaitingFrames,
)
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracked_clips import Prompt

CAMERA = guess_camera(8, 6)
PICTURE = np.zeros((6, 8, 3), np.uint8)


def frame_of(index: int) -> Frame:
    return Frame(index, index, index, PICTURE, CAMERA)


def as_lost(frame: Frame, reason: str) -> Tracked:
    return Tracked.as_lost(frame, 0, reason)


def entered(count: int, state: Wait) -> WaitingFrames:
    waiting = WaitingFrames()
    for index in range(count):
        waiting.enter(frame_of(index))
    waiting.move(Wait.IN_HAND, state)
    return waiting


def test_a_frame_is_in_one_state_at_a_time() -> None:
    waiting = entered(3, Wait.INITIALISING)
    waiting.put([frame_of(1)], Wait.THINNED)
    assert [frame.index for frame in waiting.of(Wait.INITIALISING)] == [0, 2]
    assert [frame.index for frame in waiting.of(Wait.THINNED)] == [1]


def test_a_frame_that_has_left_does_not_come_back() -> None:
    waiting = entered(1, Wait.IN_HAND)
    lost = as_lost(frame_of(0), "")
    assert waiting.settle([lost, lost], as_lost) == [lost]
    waiting.put([frame_of(0)], Wait.LOST)
    assert waiting.count(Wait.LOST) == 0
    assert waiting.settle([lost], as_lost) == []


def test_what_stays_in_hand_is_lost() -> None:
    [lost] = entered(1, Wait.IN_HAND).settle([], as_lost)
    assert (lost.frame.index, lost.reason) == (0, "no pose found")


@pytest.mark.parametrize("state", BOUNDS)
def test_the_oldest_beyond_a_bound_leave_with_its_reason(state: Wait) -> None:
    most, reason = BOUNDS[state]
    waiting = entered(most + 2, state)
    left = waiting.settle([], as_lost)
    assert [(tracked.frame.index, tracked.reason) for tracked in left] == [(0, reason), (1, reason)]
    assert waiting.count(state) == most


# --- a tracker whose every step turns out as it is drawn ------------------------------------------


class Drawn:
    """What each step comes to; once all outcomes are used, none works any more."""

    def __init__(self, outcomes: list[int]) -> None:
        self._outcomes = iter(outcomes)

    def works(self) -> bool:
        """Two of five steps work, two do not, and one raises."""
        outcome = next(self._outcomes, 0) % 5
        if outcome == 4:
            raise FloatingPointError("drawn")
        return outcome % 2 == 1


class DrawnInitialiser:
    """Keeps frames as the real one does."""

    def __init__(self, drawn: Drawn, frame: Frame) -> None:
        self.frame, self._drawn = frame, drawn
        self.waiting: list[Any] = []

    def add(self, frame: Frame, encoding: Encoding) -> bool:
        works = self._drawn.works()
        if works:
            self.waiting.append(SimpleNamespace(frame=frame, pair=None))
        return works

    def thin(self) -> list[Frame]:
        return [self.waiting.pop(1).frame] if len(self.waiting) > 3 else []

    @property
    def ready(self) -> bool:
        return self._drawn.works()

    def solve(self) -> Any:
        if not self._drawn.works():
            return None
        T = [Sim3.identity() for _ in self.waiting]
        return SimpleNamespace(waiting=self.waiting, T=T, camera=CAMERA, focal_sigma=0.0)


class DrawnTracker(Tracker):
    """Everything that looks at a picture is drawn; who waits for what, and how long, is real."""

    def __init__(self, drawn: Drawn, worker: Worker) -> None:
        at: Any = SimpleNamespace(number=0, sub_map=0, T_wc=Sim3.identity())
        found = SimpleNamespace(keyframe=at, estimate=SimpleNamespace(T=Sim3.identity()))
        prior: Any = SimpleNamespace(encode=lambda *_: drawn.works() or None)
        keyframes: Any = SimpleNamespace(hold=lambda number: at)
        places: Any = SimpleNamespace(of_frame=lambda *_: found if drawn.works() else None)
        failures = Failures(strict=False)
        super().__init__(
            prior, keyframes, TrackingConfig(lost_after=3), places, failures, worker=worker
        )
        self._drawn = drawn
        keyframe_tracker: Any = self._keyframe_tracker
        keyframe_tracker.place = lambda *_: (drawn.works(), None)[1]
        keyframe_tracker.leave = lambda at: None
        keyframe_tracker.at_new_keyframe = lambda *_: (drawn.works(), CurrentKeyframe(at))[1]

    def _placed(
        self, frame: Frame, encoding: Encoding, pair: PairGeometry | None
    ) -> Tracked | None:
        assert self._at is not None
        works = self._drawn.works()
        return self._at.tracked_result(frame, FrameClass.COMMON, Quality()) if works else None


@given(
    outcomes=st.lists(st.integers(0, 4), max_size=200),
    count=st.integers(0, 40),
    kind=st.sampled_from([Worker, Prompt]),
)
def test_every_frame_that_enters_leaves_once_whatever_each_step_comes_to(
    defects_so_far: list[str], outcomes: list[int], count: int, kind: type[Worker]
) -> None:
    drawn = Drawn(outcomes)
    few = {state: Bound(4, bound.reason) for state, bound in BOUNDS.items()}
    pointmap = Pointmap.unknown(CAMERA)
    with (
        patch.dict(BOUNDS, few),
        patch.object(map_start, "Initialiser", lambda frame, *_: DrawnInitialiser(drawn, frame)),
        patch.object(map_start, "fused_pointmap", lambda *_: pointmap),
    ):
        tracker, left = DrawnTracker(drawn, kind(Failures(strict=False))), []
        for index in range(count):
            left += tracker.track(frame_of(index)).frames
            if index % 3 == 0:
                left += tracker.back_fill().frames
            assert tracker._waiting.count(Wait.IN_HAND) == 0
            assert all(tracker._waiting.count(state) <= 4 for state in BOUNDS)
        left += tracker.finish().frames
    assert sorted(tracked.frame.index for tracked in left) == list(range(count))
    assert tracker.past is None
    defects_so_far.clear()  # what a stand-in lacks raises too, as one more outcome of a step
