"""Poses of the past: frames from before a keyframe was there, placed against it one by one."""

from __future__ import annotations

from dataclasses import replace

from aquaflow.failures import Failures
from aquaflow.geometry.camera import CameraModel
from aquaflow.messages import Frame
from aquaflow.prior.contract import Prior
from aquaflow.tracking.attachment import Attachment, Follower
from aquaflow.tracking.frames import FrameClass, Tracked


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

    def step(self) -> Tracked:
        """The newest frame that is left, with its pose if it has one."""
        frame, at = self.frames.pop(), self._at
        solved = None
        with self._failures.contain("pose", frame.index):
            encoding = self._prior.encode(frame.image, self._camera)
            solved = self._follower.place(at, encoding, self._camera)
        if solved is None:
            return Tracked.lost(frame, at.keyframe.sub_map)
        at.T_fk = solved.estimate.T
        return at.tracked(frame, FrameClass.COMMON, solved.quality)

    def all(self) -> list[Tracked]:
        """Every frame that is left, the oldest first."""
        tracked = []
        while self.frames:
            tracked.append(self.step())
        return tracked[::-1]
