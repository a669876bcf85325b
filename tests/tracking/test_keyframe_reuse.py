"""An earlier keyframe is looked for beside tracking, which goes on meanwhile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking.current_keyframe import KeyframeTracker
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.keyframe_reuse import STAGE, ReuseResult, leaves
from aquaflow.tracking.tracker import Tracker
from tests.tracking.tracked_clips import PLACED, QUICK, SMALL, error_share, path, told
from tests.tracking.tracking_scenes import CAMERA, pose

THERE = path(12)
HOVER = [*THERE, *(THERE[::-1] + THERE) * 2]
"""Out, and twice back and out again."""


class Answering(Worker):
    """Looks for keyframes in its thread; all else goes as in a replay."""

    def __init__(self, failures: Failures) -> None:
        super().__init__(failures, threads=True)

    @property
    def in_step(self) -> bool:
        return True


@dataclass
class Swim:
    """A clip of a live run whose answers the test holds back."""

    poses: Sequence[Sim3]
    failures: Failures = field(default_factory=lambda: Failures(strict=False))
    tracked: list[Tracked] = field(default_factory=list)

    def __post_init__(self) -> None:
        prior = told(self.poses)
        self.store, self.worker = KeyframeStore(), Answering(self.failures)
        self.frames = iter(prior.frames(SMALL))
        self.tracker = Tracker(prior, self.store, QUICK, failures=self.failures, worker=self.worker)

    def next(self, answers: bool) -> None:
        """One frame; before it all ``answers``, or none."""
        if answers:
            self.answer()
        self.tracked += self.tracker.track(next(self.frames)).frames

    def answer(self) -> None:
        """Every answer is taken."""
        for each in self.worker.take_finished(wait=True):
            if isinstance(each.found, ReuseResult):
                self.tracker.return_to(each.found)

    @contextmanager
    def until_asked(self) -> Iterator[None]:
        """Frames up to one at which a keyframe is due and an earlier one is looked for, which ends
        with this context only."""
        held = Event()
        while not self.worker.waiting(STAGE):
            self.answer()
            self.worker.ask("hold", 0, lambda: held.wait(60.0))
            self.tracked += self.tracker.track(next(self.frames)).frames
            if not self.worker.waiting(STAGE):
                held.set()
                self.answer()
                held.clear()
        yield
        held.set()


@pytest.fixture
def swim() -> Iterator[Swim]:
    swim = Swim(HOVER)
    yield swim
    swim.worker.close()


def test_hovering_adds_no_keyframes_where_answers_come_a_frame_later(swim: Swim) -> None:
    for _ in HOVER:
        swim.next(answers=True)
    first = Swim(THERE)
    for _ in THERE:
        first.next(answers=True)
    first.worker.close()
    assert len(swim.store) == len(first.store) > 1
    assert {t.frame_class for t in swim.tracked} <= PLACED
    assert error_share(swim.tracked, HOVER) < 0.01
    assert [tracked.keyframe for tracked in swim.tracked][len(THERE) :].count(0) > 2


def test_no_keyframe_is_made_until_the_answer_is_there(swim: Swim) -> None:
    with swim.until_asked():
        made = len(swim.store)
        for _ in range(3):
            swim.next(answers=False)
        assert {t.frame_class for t in swim.tracked[-3:]} == {FrameClass.COMMON}
        assert len(swim.store) == made


def test_tracking_goes_on_at_an_earlier_keyframe_from_where_the_camera_is_by_then(
    swim: Swim,
) -> None:
    with swim.until_asked():
        before = swim.tracker._at
        for _ in range(3):
            swim.next(answers=False)
    while swim.tracker._at is before:
        swim.next(answers=True)
    for _ in range(4):
        swim.next(answers=True)
    assert {t.frame_class for t in swim.tracked} <= PLACED
    assert error_share(swim.tracked, HOVER) < 0.01


def test_an_answer_for_a_keyframe_that_was_left_meanwhile_is_dropped(swim: Swim) -> None:
    with swim.until_asked():
        swim.tracker._at = None
    swim.answer()
    assert swim.tracker._at is None
    assert not swim.failures.kinds


def test_where_looking_fails_a_keyframe_is_made(
    swim: Swim, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("told so")

    monkeypatch.setattr(KeyframeTracker, "back_at", fail)
    for _ in HOVER:
        swim.next(answers=True)
    (failure,) = swim.failures.kinds
    assert failure.stage == STAGE
    assert failure.first_frame is not None
    assert swim.store.keyframes[-1].frame_index > failure.first_frame
    assert {t.frame_class for t in swim.tracked} <= PLACED


@pytest.mark.parametrize(
    ("here", "parallax_px", "left"),
    [
        ((0.0, 0.0, -0.3), 8.0, True),
        ((0.0, 0.0, -0.3), 2.0, False),  # matches are lost for another reason
        ((0.0, 0.0, -0.05), 8.0, False),  # it only turned
        ((0.0, 0.0, 0.25), 8.0, False),  # it comes back to the others
    ],
)
def test_a_camera_leaves_its_keyframes_that_is_beyond_all_of_them(
    here: tuple[float, float, float], parallax_px: float, left: bool
) -> None:
    still = (0.0, 0.0, 0.0)
    others = [SimpleNamespace(keyframe=SimpleNamespace(T_wc=pose(still, (0.0, 0.0, 0.3))))]
    look: Any = SimpleNamespace(
        at=SimpleNamespace(keyframe=SimpleNamespace(T_wc=pose(still, still))),
        T_fk=pose(still, here).inverse(),
        solved=SimpleNamespace(parallax_px=parallax_px),
        camera=CAMERA,
        around=others,
    )
    assert leaves(look) == left
