"""Poses of the past: frames from before a keyframe was there, placed against it one by one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from aquaflow.errors.failures import Failures
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.messages import Frame
from aquaflow.prior.contract import Encoding, Prior
from aquaflow.tracking.current_keyframe import Attachment, Follower
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.pose.matcher import Matched


@dataclass(frozen=True)
class _Placed:
    """A frame that got its pose."""

    frame: Frame
    encoding: Encoding
    solved: Matched
    at: Attachment
    """What it was placed against."""
    T_fk: Sim3
    """From the keyframe that all poses refer to."""

    def as_keyframe(self, follower: Follower, camera: CameraModel) -> tuple[Attachment, Sim3]:
        """Itself with the depths that it took along, for others to be placed against; T_fk."""
        pointmap = follower.pointmap(self.at, self.solved, camera)
        frame, sub_map = self.frame, self.at.keyframe.sub_map
        # In a store of its own: the dive's keyframes are others.
        keyframe = KeyframeStore().add(
            frame.index, frame.t_ns, self.encoding, Sim3.identity(), pointmap, sub_map
        )
        return Attachment(keyframe), self.T_fk


class BackFill:
    """Goes from the newest frame back; nothing that the keyframe knows changes."""

    def __init__(
        self,
        frames: list[Frame],
        at: Attachment,
        camera: CameraModel,
        prior: Prior,
        follower: Follower,
        failures: Failures,
    ) -> None:
        """``at``: where the newest of the frames, which come oldest first, is looked for."""
        self.frames = frames
        """What is left."""
        self._at, self._camera = replace(at), camera
        self._prior, self._follower, self._failures = prior, follower, failures
        self._last: _Placed | None = None

    def step(self) -> Tracked:
        """The newest frame that is left, with its pose if it has one."""
        frame, at = self.frames.pop(), self._at
        placed = None
        with self._failures.contain("pose", frame.index):
            placed = self._place(frame)
        if placed is None:
            return Tracked.lost(frame, at.keyframe.sub_map)
        self._last = placed
        at.T_fk = placed.T_fk
        return at.tracked(frame, FrameClass.COMMON, placed.solved.quality)

    def _place(self, frame: Frame) -> _Placed | None:
        """At the keyframe; where the frame no longer shows that, at the frame placed before."""
        encoding = self._prior.encode(frame.image, self._camera)
        solved = self._follower.place(self._at, encoding, self._camera)
        if solved is not None:
            return _Placed(frame, encoding, solved, self._at, solved.estimate.T)
        if self._last is None:
            return None
        at, T_ak = self._last.as_keyframe(self._follower, self._camera)
        solved = self._follower.place(at, encoding, self._camera)
        if solved is None:
            return None
        return _Placed(frame, encoding, solved, at, solved.estimate.T @ T_ak)

    def all(self) -> list[Tracked]:
        """Every frame that is left, the oldest first."""
        tracked = []
        while self.frames:
            tracked.append(self.step())
        return tracked[::-1]
