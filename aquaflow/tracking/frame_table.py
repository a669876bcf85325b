"""Finished frames of a dive, one row of numbers each, to bound the memory of a long dive.

A frame's pose is kept against its keyframe; the keyframe's own pose, which later corrections move,
makes it the frame's pose in the world.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.geometry.arrays import SIM3, Array, of_sim3, to_sim3
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from aquaflow.types import CameraModel, Frame

CLASSES = list(FrameClass)
"""A row holds a class by its place in here."""
NONE = -1
"""The keyframe of a frame that has no pose."""
CHUNK = 1024
"""Rows allocated at once."""

FRAME = np.dtype(
    [
        ("index", np.int64), ("t_ns", np.int64), ("class", np.uint8), ("sub_map", np.int32),
        ("keyframe", np.int64), ("quality", np.float64, 4), ("T_kf", np.float64, SIM3),
    ]
)  # fmt: skip
"""One row; ``T_kf`` is the frame's pose in its keyframe."""
NO_PICTURE = np.empty((0, 0, 3), np.uint8)
"""A frame out of the table has no pixels any more."""


class FrameTable:
    """Finished frames, in completion order; 165 bytes for each."""

    def __init__(self) -> None:
        self._chunks: list[Array] = []
        self._count = 0
        self._camera: CameraModel | None = None

    @staticmethod
    def of_rows(
        rows: Array,  # [N] FRAME
        camera: CameraModel,
    ) -> FrameTable:
        """The table whose :meth:`rows` are given; ``camera`` took the frames."""
        table = FrameTable()
        table._chunks = [np.zeros(CHUNK, FRAME) for _ in range(-(-len(rows) // CHUNK))]
        for i, chunk in enumerate(table._chunks):
            part = rows[i * CHUNK : (i + 1) * CHUNK]
            chunk[: len(part)] = part
        table._count, table._camera = len(rows), camera
        return table

    def add(self, tracked: Tracked, T_kf: Sim3 | None) -> None:
        """A frame and its pose against its keyframe; None: it has no pose."""
        if self._count == len(self._chunks) * CHUNK:
            self._chunks.append(np.zeros(CHUNK, FRAME))
        frame, q = tracked.frame, tracked.quality
        keyframe = NONE if T_kf is None else tracked.keyframe
        pose = np.zeros(SIM3) if T_kf is None else of_sim3([T_kf])[0]
        quality = (q.inlier_share, q.residual_px, q.matched_share, q.conditioning)
        kind = CLASSES.index(tracked.frame_class)
        self._chunks[-1][self._count % CHUNK] = (
            frame.index, frame.t_ns, kind, tracked.sub_map, keyframe, quality, pose,
        )  # fmt: skip
        self._count += 1
        self._camera = frame.camera

    def move(self, keyframe: int, moved: Callable[[Sim3], Sim3]) -> None:
        """Replace the poses of all frames in a keyframe."""
        for i, chunk in enumerate(self._chunks):
            rows = np.flatnonzero(chunk["keyframe"][: self._count - i * CHUNK] == keyframe)
            if len(rows) > 0:
                # Of a copy, for parts that were handed out stay as they were.
                self._chunks[i] = chunk.copy()
                poses = [moved(to_sim3(pose)) for pose in chunk["T_kf"][rows]]
                self._chunks[i]["T_kf"][rows] = of_sim3(poses)

    def rows(self) -> Array:
        """[N] FRAME, a copy."""
        return np.concatenate(self.parts())

    def parts(self) -> list[Array]:
        """The same in pieces [n] that never change again; their cost hardly grows with the dive."""
        whole, rest = divmod(self._count, CHUNK)
        newest = self._chunks[whole][:rest].copy() if rest else np.zeros(0, FRAME)
        return [*self._chunks[:whole], newest]

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[tuple[Tracked, Sim3 | None]]:
        return self.since(0)

    def since(self, first: int) -> Iterator[tuple[Tracked, Sim3 | None]]:
        """The frames from row ``first`` on, without pictures and reasons, and their poses against
        their keyframes."""
        for i in range(first, self._count):
            yield self[i]

    def __getitem__(self, i: int) -> tuple[Tracked, Sim3 | None]:
        """The frame of row ``i``, as :meth:`since` gives it."""
        assert self._camera is not None
        row = self._chunks[i // CHUNK][i % CHUNK]
        index, t_ns, sub_map = (int(row[name]) for name in ("index", "t_ns", "sub_map"))
        frame = Frame(index, t_ns, t_ns, NO_PICTURE, self._camera)
        kind, number = CLASSES[int(row["class"])], int(row["keyframe"])
        if number == NONE:
            return Tracked(frame, kind, sub_map), None
        quality = Quality(*row["quality"].tolist())
        return Tracked(frame, kind, sub_map, number, quality=quality), to_sim3(row["T_kf"])


# --------------------------------------------------------------------------------------------------
# Poses relative to keyframes: a frame moves with its keyframe in every later correction.


@dataclass(frozen=True)
class RelativeFrame:
    """A tracked frame with its pose relative to its keyframe, unchanged by later corrections."""

    tracked: Tracked
    T_kf: Sim3 | None = None
    """None for a frame without a pose."""


class RelativePoses:
    """Computes a frame's pose relative to its keyframe from its pose in the world, and back.

    A frame for which this fails is lost, and counted in ``failures``.
    """

    def __init__(self, keyframes: KeyframeStore, failures: Failures) -> None:
        self._keyframes, self._failures = keyframes, failures

    def relative_pose(self, tracked: Tracked) -> RelativeFrame:
        """The frame as tracked, with its pose relative to its keyframe."""
        if tracked.keyframe is None or tracked.T_wc is None:
            return RelativeFrame(tracked)
        with self._failures.contain("pose", tracked.frame.index):
            T_kf = self._keyframes[tracked.keyframe].T_wc.inverse() @ tracked.T_wc
            return RelativeFrame(tracked, T_kf.if_finite())
        return RelativeFrame(self._lost_frame(tracked))

    def world_pose(self, tracked: Tracked, T_kf: Sim3 | None) -> Tracked:
        """The frame with the pose and sub-map that its keyframe gives it now; lost if none."""
        if tracked.keyframe is None or T_kf is None:
            return tracked
        keyframe = self._keyframes[tracked.keyframe]
        with self._failures.contain("pose", tracked.frame.index):
            T_wc = (keyframe.T_wc @ T_kf).if_finite()
            return replace(tracked, T_wc=T_wc, sub_map=keyframe.sub_map)
        return self._lost_frame(tracked)

    def _lost_frame(self, tracked: Tracked) -> Tracked:
        reason = self._failures.reason(tracked.frame.index) or "tracking failed"
        return Tracked.as_lost(tracked.frame, tracked.sub_map, reason)
