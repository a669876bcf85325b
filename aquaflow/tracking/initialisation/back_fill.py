"""Back-fill: poses of frames from before a keyframe existed, one by one against that keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from aquaflow.clocks.deadline import Deadline
from aquaflow.errors.failures import Failures
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.messages import Frame
from aquaflow.prior.contract import Encoding, Prior
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.tracking.waiting_frames import Wait, WaitingFrames


@dataclass(frozen=True)
class _Placed:
    """A frame that got its pose."""

    frame: Frame
    encoding: Encoding
    solved: Matched
    at: CurrentKeyframe
    """The keyframe or frame that the pose is relative to."""
    T_fk: Sim3
    """From the keyframe of all poses to this frame."""

    def as_keyframe(
        self, keyframe_tracker: KeyframeTracker, camera: CameraModel
    ) -> tuple[CurrentKeyframe, Sim3]:
        """The frame as a keyframe with the transferred depths, against which others are posed;
        T_fk."""
        pointmap, _ = keyframe_tracker.pointmap(self.at, self.solved, camera)
        frame, sub_map = self.frame, self.at.keyframe.sub_map
        # In a store of its own: the dive's keyframes are others.
        keyframe = KeyframeStore().add(
            frame.index, frame.t_ns, self.encoding, Sim3.identity(), pointmap, sub_map
        )
        return CurrentKeyframe(keyframe), self.T_fk


class BackFill:
    """Goes from the newest frame back; does not change the keyframe."""

    def __init__(
        self,
        frames: Sequence[Frame],
        at: CurrentKeyframe,
        camera: CameraModel,
        prior: Prior,
        keyframe_tracker: KeyframeTracker,
        failures: Failures,
    ) -> None:
        """``at``: where the newest of the frames, which come oldest first, is looked for."""
        self._indices = frozenset(frame.index for frame in frames)
        self._at, self._camera = replace(at), camera
        self._prior, self._keyframe_tracker, self._failures = prior, keyframe_tracker, failures
        self._last: _Placed | None = None

    def left(self, waiting: Sequence[Frame]) -> list[Frame]:
        """Those of its frames that still wait."""
        return [frame for frame in waiting if frame.index in self._indices]

    def step(self, frame: Frame) -> Tracked:
        """The newest frame that is left, with its pose if it has one."""
        at, placed = self._at, None
        with self._failures.contain("pose", frame.index):
            placed = self._place(frame)
        if placed is None:
            return Tracked.lost(frame, at.keyframe.sub_map)
        self._last = placed
        at.T_fk = placed.T_fk
        return at.tracked(frame, FrameClass.COMMON, placed.solved.quality)

    def _place(self, frame: Frame) -> _Placed | None:
        """At the keyframe; where the frame no longer shows that, at the frame placed before."""
        encoding = self._prior.encode(frame.image, self._camera, frame.mask)
        solved = self._keyframe_tracker.place(self._at, encoding, self._camera)
        if solved is not None:
            return _Placed(frame, encoding, solved, self._at, solved.estimate.T)
        if self._last is None:
            return None
        at, T_ak = self._last.as_keyframe(self._keyframe_tracker, self._camera)
        solved = self._keyframe_tracker.place(at, encoding, self._camera)
        if solved is None:
            return None
        return _Placed(frame, encoding, solved, at, solved.estimate.T @ T_ak)

    def all(self, frames: Sequence[Frame], until: Deadline | None = None) -> list[Tracked]:
        """Every one of ``frames``, those that are left; the oldest first. Where the time does not
        last, the newest of them."""
        done = []
        for frame in reversed(frames):
            if until is not None and until.over:
                break
            done.append(self.step(frame))
        return done[::-1]


class BackFills:
    """Poses of frames that waited for a keyframe: at once or, in a live run, in its idle time."""

    def __init__(
        self,
        waiting: WaitingFrames,
        prior: Prior,
        keyframe_tracker: KeyframeTracker,
        failures: Failures,
        live: bool,
    ) -> None:
        self._waiting, self._prior, self._keyframe_tracker = waiting, prior, keyframe_tracker
        self._failures, self._live = failures, live
        self._left: list[BackFill] = []
        """The frames left for idle time, in processing order."""

    def start(self, at: CurrentKeyframe, camera: CameraModel) -> list[Tracked]:
        """Against ``at``, all frames that wait for a keyframe; those that are placed at once."""
        after = Wait.IN_IDLE_TIME if self._live else Wait.IN_HAND
        frames = self._waiting.move(Wait.FOR_A_KEYFRAME, after)
        if not frames:
            return []
        fill = BackFill(frames, at, camera, self._prior, self._keyframe_tracker, self._failures)
        if not self._live:
            return fill.all(frames)
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        self._left = [each for each in (*self._left, fill) if each.left(waiting)]
        return []

    @property
    def next(self) -> Frame | None:
        """The frame that :meth:`step` will process next."""
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        return next((left[-1] for fill in self._left if (left := fill.left(waiting))), None)

    def step(self) -> list[Tracked]:
        """Process :attr:`next`, which gets a pose or none; returns nothing if no frame waits."""
        waiting = self._waiting.of(Wait.IN_IDLE_TIME)
        self._left = [fill for fill in self._left if fill.left(waiting)]
        if not self._left:
            return []
        frame = self._left[0].left(waiting)[-1]
        self._waiting.put([frame], Wait.IN_HAND)
        return [self._left[0].step(frame)]

    def all(self, until: Deadline | None = None) -> list[Tracked]:
        """Every frame that waits for idle time, or those that there is time for."""
        waiting = self._waiting.move(Wait.IN_IDLE_TIME, Wait.IN_HAND)
        fills, self._left = self._left, []
        return [tracked for fill in fills for tracked in fill.all(fill.left(waiting), until)]
