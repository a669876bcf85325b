"""Serialisation of tracking for a checkpoint: graph, keyframes, every frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config import Config
from aquaflow.dive.run import DiveRun
from aquaflow.geometry.arrays import (
    Arrays,
    Cameras,
    add_prefix,
    of_camera,
    of_sim3,
    to_camera,
    to_sim3,
    under,
)
from aquaflow.live.checkpoint import base as in_site
from aquaflow.slam import Slam
from aquaflow.tracking.frame_table import FrameTable
from aquaflow.tracking.graph.pose_graph import PoseGraph


def serialise(slam: Slam, run: DiveRun) -> tuple[dict[str, Any], Arrays] | None:
    """Facts for JSON, and arrays; None before the first keyframe, when the state is empty.

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
        "source": _size_settings(slam.config),
        "notes": list(run.notes),
        "lost_keyframes": sorted(slam.keyframes.lost),
    }
    own: Arrays = {}
    if slam.in_base is not None:
        facts["in_site"], own = in_site.serialise(slam.in_base)
    arrays = {
        **own,
        "frames": slam.frames.rows(),
        "keyframes": np.array(rows, np.int64).reshape(-1, 5),
        "poses": of_sim3([keyframe.T_wc for keyframe in keyframes]),
        **add_prefix("graph", dict(slam.graph.graph.tables())),
    }
    return facts, arrays


def deserialise(
    slam: Slam,
    run: DiveRun,
    facts: dict[str, Any],
    arrays: Arrays,  # as from serialise
) -> None:
    """Restore a new ``slam`` and ``run`` to the state of the serialised ones.

    Raises:
        InputError: it holds no pose.
        KeyError, ValueError, TypeError: this is no such checkpoint.
    """
    cameras = [to_camera(values) for values in facts["cameras"]]
    for row, pose in zip(arrays["keyframes"].tolist(), arrays["poses"], strict=True):
        frame_index, t_ns, sub_map, *pair = row
        slam.keyframes.restore(
            frame_index, t_ns, to_sim3(pose), sub_map, (cameras[pair[0]], cameras[pair[1]])
        )
    graph = PoseGraph.of_tables(under("graph", arrays), slam.config.tracking.graph)
    slam.graph.resume(graph, int(facts["loops"]))
    slam.skipped.update(facts["skipped"])
    camera = to_camera(facts["camera"])
    slam.resume(FrameTable.of_rows(arrays["frames"], camera), int(facts["used"]))
    run.first_pose_s = facts["first_pose_s"]
    rows = reversed(range(len(slam.frames)))
    row = next((i for i in rows if slam.frames[i][1] is not None), None)
    last = None if row is None else slam.results(row)[0].T_wc
    if last is None:
        raise InputError("it holds no pose")
    slam.tracker.resume(camera, float(facts["focal_sigma"]), int(facts["sub_maps"]), last)
    run.notes += facts["notes"]
    if slam.in_base is not None and "in_site" in facts:
        in_site.restore(slam.in_base, facts["in_site"], arrays)
    for keyframe in slam.keyframes.keyframes:
        if keyframe.number not in slam.keyframes.lost:
            slam.tracker.recall(keyframe)


def lost_since(slam: Slam, facts: dict[str, Any]) -> set[int]:
    """Keyframes that were intact when the checkpoint was taken and are lost now."""
    return slam.keyframes.lost - set(facts["lost_keyframes"])


def refuse_another_size(dive: Path, facts: dict[str, Any], config: Config) -> None:
    """Check the picture size: poses and maps are in pixels of one size.

    Raises:
        ConfigError: ``config`` asks for pictures of another width, or cropped in another way.
    """
    asked = _size_settings(config)
    for name, before in facts["source"].items():
        if asked[name] != before:
            was, now = (value or "the default" for value in (before, asked[name]))
            raise ConfigError(
                f"{dive} was begun with source.{name} {was} and cannot be resumed with {now}; "
                f"give the same {name}, or start another dive"
            )


def _size_settings(config: Config) -> dict[str, Any]:
    """The settings that determine the size of the mapped pictures."""
    return {"width": config.source.width, "crop": config.source.crop}
