"""Tracking taken apart for a checkpoint, and put together again: graph, keyframes, every frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aquaflow.dive_run import DiveRun
from aquaflow.errors import InputError
from aquaflow.messages import Frame
from aquaflow.plain_arrays import (
    Array,
    Arrays,
    Cameras,
    of_camera,
    of_sim3,
    prefixed,
    to_camera,
    to_sim3,
    under,
)
from aquaflow.slam import Slam
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from aquaflow.tracking.pose_graph import PoseGraph

CLASSES = list(FrameClass)
NONE = -1

FRAME = np.dtype(
    [
        ("index", np.int64), ("t_ns", np.int64), ("class", np.uint8), ("sub_map", np.int32),
        ("keyframe", np.int64), ("quality", np.float64, 4), ("T_kf", np.float64, 13),
    ]
)  # fmt: skip
"""A frame whose fate is known; keyframe -1: it has no pose."""


class FrameTable:
    """The frames of a run as rows, each made once."""

    def __init__(self) -> None:
        self._chunks: list[Array] = []
        self._count = 0

    def rows(self, slam: Slam, results: Sequence[Tracked]) -> Array:
        """[N] FRAME of ``results``, of which only those at the end are new since the last time."""
        new = results[self._count :]
        if new:
            self._chunks.append(np.array([_row(slam, tracked) for tracked in new], FRAME))
            self._count = len(results)
        return np.concatenate(self._chunks) if self._chunks else np.zeros(0, FRAME)


def _row(slam: Slam, tracked: Tracked) -> tuple[object, ...]:
    T_kf = slam.anchor(tracked.frame.index) if tracked.keyframe is not None else None
    posed = T_kf is not None
    q = tracked.quality
    quality = (q.inlier_share, q.residual_px, q.matched_share, q.conditioning)
    pose = of_sim3([T_kf])[0] if T_kf is not None else np.zeros(13)
    keyframe = tracked.keyframe if posed else NONE
    kind = CLASSES.index(tracked.frame_class)
    frame = tracked.frame
    return (frame.index, frame.t_ns, kind, tracked.sub_map, keyframe, quality, pose)


def take_apart(slam: Slam, run: DiveRun, table: FrameTable) -> tuple[dict[str, Any], Arrays] | None:
    """Facts for JSON, and arrays; None before the first keyframe, when there is nothing to keep.

    Quick: what is large is shared, and nothing of it changes later.
    """
    camera = slam.tracker.camera
    if camera is None or not len(slam.keyframes):
        return None
    keyframes, cameras = slam.keyframes.keyframes, Cameras()
    pairs = [slam.keyframes.cameras_of(keyframe.number) for keyframe in keyframes]
    numbered = [[cameras.number(each) for each in pair] for pair in pairs]
    rows = [
        (k.frame_index, k.t_ns, k.sub_map, *c) for k, c in zip(keyframes, numbered, strict=True)
    ]
    facts = {
        "camera": of_camera(camera),
        "focal_sigma": slam.tracker.focal_sigma,
        "sub_maps": slam.tracker.sub_maps,
        "used": slam.used,
        "loops": slam.graph.loops,
        "skipped": dict(slam.skipped),
        "cameras": cameras.to_json(),
        "first_pose_s": run.first_pose_s,
    }
    arrays = {
        "frames": table.rows(slam, run.results),
        "keyframes": np.array(rows, np.int64).reshape(-1, 5),
        "poses": of_sim3([keyframe.T_wc for keyframe in keyframes]),
        **prefixed("graph", dict(slam.graph.graph.tables())),
    }
    return facts, arrays


def put_together(slam: Slam, run: DiveRun, facts: dict[str, Any], arrays: Arrays) -> None:
    """Let a fresh ``slam`` and ``run`` go on where those that were taken apart stood.

    Raises:
        InputError: a keyframe's file is gone.
        KeyError, ValueError, TypeError: this is no such checkpoint.
    """
    cameras = [to_camera(values) for values in facts["cameras"]]
    for row, pose in zip(arrays["keyframes"].tolist(), arrays["poses"], strict=True):
        frame_index, t_ns, sub_map, *pair = row
        slam.keyframes.adopt(
            frame_index, t_ns, to_sim3(pose), sub_map, (cameras[pair[0]], cameras[pair[1]])
        )
    graph = PoseGraph.of_tables(under("graph", arrays), slam.config.tracking.graph)
    slam.graph.resume(graph, int(facts["loops"]))
    slam.skipped.update(facts["skipped"])
    camera = to_camera(facts["camera"])
    T_kf = {int(row["index"]): to_sim3(row["T_kf"]) for row in arrays["frames"] if _posed(row)}
    slam.resume(T_kf, int(facts["used"]))
    run.results = [_tracked(slam, row, T_kf, camera) for row in arrays["frames"]]
    run.first_pose_s = facts["first_pose_s"]
    posed = [tracked for tracked in run.results if tracked.T_wc is not None]
    if not posed:
        raise InputError("the checkpoint holds no pose; start with --new")
    last = posed[-1].T_wc
    assert last is not None
    slam.tracker.resume(camera, float(facts["focal_sigma"]), int(facts["sub_maps"]), last)
    for keyframe in slam.keyframes.keyframes:
        slam.tracker.recall(keyframe)


def _posed(row: Array) -> bool:
    return bool(row["keyframe"] != NONE)


def _tracked(slam: Slam, row: Array, T_kf: dict[int, Any], camera: Any) -> Tracked:
    index, t_ns = int(row["index"]), int(row["t_ns"])
    frame = Frame(index, t_ns, t_ns, np.empty((0, 0, 3), np.uint8), camera)
    kind, sub_map = CLASSES[int(row["class"])], int(row["sub_map"])
    if not _posed(row):
        return Tracked(frame, kind, sub_map, reason="before a restart")
    number = int(row["keyframe"])
    T_wc = slam.keyframes[number].T_wc @ T_kf[index]
    return Tracked(frame, kind, sub_map, number, T_wc, Quality(*row["quality"].tolist()))
