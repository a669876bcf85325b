"""Back-fill: poses of frames from before a keyframe existed, one by one against that keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.contract import Encoding, Prior
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.frames import FrameClass, Tracked, Wait, WaitingFrames
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.types import Frame

STAGE = "back-fill"
"""Name of this work."""


@dataclass(frozen=True)
class BackFilledFrame:
    """A frame that got its pose."""

    frame: Frame
    encoding: Encoding
    solved: Matched
    at: CurrentKeyframe
    """The keyframe or frame that was matched."""
    T_fk: Sim3
    """From the keyframe of all poses to this frame."""

    def as_keyframe(
        self, keyframe_tracker: KeyframeTracker, camera: CameraModel
    ) -> CurrentKeyframe:
        """The frame as a keyframe with the transferred depths, against which others are posed."""
        pointmap, _ = keyframe_tracker.pointmap(self.at, self.solved, camera)
        frame, sub_map = self.frame, self.at.keyframe.sub_map
        # In a store of its own: the dive's keyframes are others.
        keyframe = KeyframeStore().add(
            frame.index, frame.t_ns, self.encoding, Sim3.identity(), pointmap, sub_map
        )
        return CurrentKeyframe(keyframe, motion=self.at.motion)


class BackFill:
    """Goes from the newest frame back; does not change the keyframe.

    A frame at which a keyframe would be due takes its place for those before it, with depths of its
    own: the camera may have come from out of the keyframe's view.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        at: CurrentKeyframe,
        camera: CameraModel,
        prior: Prior,
        keyframe_tracker: KeyframeTracker,
        failures: Failures,
    ) -> None:
        """``at``: where the newest of the frames, which come oldest first, is looked for, with the
        motion towards there."""
        self._indices = frozenset(frame.index for frame in frames)
        self._at, self._camera = replace(at, motion=at.motion.inverse()), camera
        self._prior, self._keyframe_tracker, self._failures = prior, keyframe_tracker, failures
        self._near, self._T_nk = self._at, Sim3.identity()
        """What frames are matched to, and its pose in the keyframe."""
        self._last: BackFilledFrame | None = None

    def waiting_frames(self, waiting: Sequence[Frame]) -> list[Frame]:
        """Those of its frames that still wait."""
        return [frame for frame in waiting if frame.index in self._indices]

    def place(self, frame: Frame) -> BackFilledFrame | None:
        """Look for the newest frame that is left; in any thread, one frame at a time."""
        with self._failures.contain("pose", frame.index):
            return self._place(frame)
        return None

    def take(self, frame: Frame, placed: BackFilledFrame | None) -> Tracked:
        """The frame, with its pose if it was ``placed``."""
        at = self._at
        if placed is None:
            return Tracked.as_lost(frame, at.keyframe.sub_map)
        self._last = placed
        if placed.at is at:
            at.moved_to(placed.T_fk, placed.solved.pair.matches)
        at.T_fk = placed.T_fk
        return at.tracked_result(frame, FrameClass.COMMON, placed.solved.quality)

    def _place(self, frame: Frame) -> BackFilledFrame | None:
        """At what was matched last; from where a keyframe would be due, or where the frame no
        longer shows that, at the frame placed before."""
        encoding = self._prior.encode(frame.image, self._camera, frame.mask)
        if self._is_due():
            self._go_on_at_last()
        solved = self._keyframe_tracker.place(self._near, encoding, self._camera)
        if solved is None and self._go_on_at_last():
            solved = self._keyframe_tracker.place(self._near, encoding, self._camera)
        if solved is None:
            return None
        near = self._near
        if near is not self._at:
            self._keyframe_tracker.take(near, solved, self._camera)
        return BackFilledFrame(frame, encoding, solved, near, solved.estimate.T @ self._T_nk)

    def _is_due(self) -> bool:
        """True if the frame placed last would have become a keyframe."""
        last, classify = self._last, self._keyframe_tracker.classify
        return last is not None and (
            classify(last.at, last.solved, self._camera) is FrameClass.KEYFRAME
        )

    def _go_on_at_last(self) -> bool:
        """Match to the frame placed last from now on; False if there is none, or it is so yet."""
        last = self._last
        if last is None:
            return False
        self._near = last.as_keyframe(self._keyframe_tracker, self._camera)
        self._T_nk, self._last = last.T_fk, None
        return True

    def all(self, frames: Sequence[Frame], until: Deadline | None = None) -> list[Tracked]:
        """Every one of ``frames``, those that are left; the oldest first. Where the time does not
        last, the newest of them."""
        done = []
        for frame in reversed(frames):
            if until is not None and until.over:
                break
            done.append(self.take(frame, self.place(frame)))
        return done[::-1]


@dataclass(frozen=True)
class BackFillResult:
    """A frame of the past that was looked for, and its pose, if one was found."""

    fill: BackFill
    frame: Frame
    placed: BackFilledFrame | None


class BackFills:
    """Poses of frames that waited for a keyframe: at once, or in idle time where the worker is not
    in step with the frames."""

    def __init__(
        self,
        waiting: WaitingFrames,
        prior: Prior,
        keyframe_tracker: KeyframeTracker,
        failures: Failures,
        worker: Worker,
    ) -> None:
        self._waiting, self._prior, self._keyframe_tracker = waiting, prior, keyframe_tracker
        self._failures, self._worker = failures, worker
        self._left: list[BackFill] = []
        """The frames left for idle time, in processing order."""
        self._answer: BackFillResult | None = None
        """Of the last frame that was looked for."""

    def start(self, at: CurrentKeyframe, camera: CameraModel) -> list[Tracked]:
        """Against ``at``, all frames that wait for a keyframe; those that are placed at once."""
        after = Wait.IN_HAND if self._worker.in_step else Wait.IN_IDLE_TIME
        frames = sorted(self._waiting.of(Wait.FOR_A_KEYFRAME), key=lambda frame: frame.index)
        self._waiting.put(frames, after)
        if not frames:
            return []
        fill = BackFill(frames, at, camera, self._prior, self._keyframe_tracker, self._failures)
        if self._worker.in_step:
            return fill.all(frames)
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        self._left = [each for each in (*self._left, fill) if each.waiting_frames(waiting)]
        return []

    @property
    def next(self) -> Frame | None:
        """The frame that :meth:`step` will finish next."""
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        return next(
            (left[-1] for fill in self._left if (left := fill.waiting_frames(waiting))), None
        )

    def step(self) -> list[Tracked]:
        """Finish :attr:`next`, which gets a pose or none, once that has been looked for; returns
        nothing until then, or if no frame waits."""
        self._look()
        answer, self._answer = self._answer, None
        if answer is None:
            return []
        self._waiting.put([answer.frame], Wait.IN_HAND)
        tracked = answer.fill.take(answer.frame, answer.placed)
        self._look()
        return [tracked]

    def _look(self) -> None:
        """Look for the next frame, unless one is looked for, or the last answer is not taken."""
        if self._answer is not None or self._worker.waiting(STAGE):
            return
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        self._left = [fill for fill in self._left if fill.waiting_frames(waiting)]
        if self._left:
            fill = self._left[0]
            frame = fill.waiting_frames(waiting)[-1]
            for found in self._worker.ask(STAGE, frame.index, partial(_look_back, fill, frame)):
                self.take(found)

    def take(self, found: BackFillResult) -> None:
        """What was found of a frame; :meth:`step` finishes it."""
        self._answer = found

    def all(self, until: Deadline | None = None) -> list[Tracked]:
        """Every frame that waits for idle time, or those that there is time for."""
        self._worker.drop(STAGE)
        self._answer = None
        waiting = self._waiting.move(Wait.IN_IDLE_TIME, Wait.IN_HAND)
        fills, self._left = self._left, []
        return [
            tracked for fill in fills for tracked in fill.all(fill.waiting_frames(waiting), until)
        ]


def _look_back(fill: BackFill, frame: Frame) -> BackFillResult:
    return BackFillResult(fill, frame, fill.place(frame))
