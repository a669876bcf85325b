"""The earlier dive that a live dive is looked for in: opened, and kept in checkpoints.

A dive that goes on keeps the place that it had in the earlier one, also where that cannot be read
any more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.geometry.arrays import Arrays, add_prefix, of_sim3, to_sim3, under
from aquaflow.keyframes.place import KeypointDepths
from aquaflow.live.checkpoint.generations import Checkpoint
from aquaflow.slam import Slam
from aquaflow.telemetry.metric_file import frame_of_json, frame_to_json
from aquaflow.tracking.base import Base, BaseLink, FirstRecognised, InBase, base_of


def localise_in_base(slam: Slam, asked: Path | None, checkpoint: Checkpoint | None) -> list[str]:
    """Look for a new dive in the earlier one that is ``asked`` for, and for one that goes on in the
    one of its ``checkpoint``. One that cannot be used costs itself, not the dive; notes say so."""
    known = None if checkpoint is None else checkpoint.facts["tracking"].get("in_site")
    folder = asked if known is None else Path(known["folder"])
    if folder is None:
        return []
    try:
        slam.localise_in(base_of(folder))
    except InputError as error:
        said = f"the dive is not looked for in {folder}"
        if known is None:
            return [f"{said}: {error}"]
        frames = {int(number): frame_of_json(each) for number, each in known["frames"].items()}
        slam.localise_in(Base(folder, slam.prior.name, (), unreadable, frames))
        return [f"{said} any more, and keeps its place there: {error}"]
    return []


def unreadable(number: int) -> KeypointDepths:
    """The message of a dive that cannot be read any more.

    Raises:
        InputError: always.
    """
    raise InputError(f"keyframe {number} of the earlier dive cannot be read")


def serialise(in_base: InBase) -> tuple[dict[str, Any], Arrays]:
    """Facts for JSON, and arrays."""
    links, first = in_base.links, in_base.first
    facts = {
        "folder": str(in_base.base.folder.resolve()),
        "frames": {str(n): frame_to_json(frame) for n, frame in in_base.base.frames.items()},
        "first": None if first is None else [first.frame, first.t_ns],
        "counts": [in_base.looked_up, in_base.passed_over, in_base.refused],
    }
    rows = [(x.keyframe, x.base_keyframe, x.base_sub_map, x.inliers) for x in links]
    arrays = {
        "links": np.array(rows, np.int64).reshape(-1, 4),
        "poses": of_sim3([link.T_sk for link in links]),
        "covariances": np.array([link.covariance for link in links]).reshape(-1, 7, 7),
    }
    return facts, add_prefix("in_site", arrays)


def restore(
    in_base: InBase,
    facts: dict[str, Any],
    arrays: Arrays,  # as from serialise
) -> None:
    """Take up what a checkpoint has of it.

    Raises:
        KeyError, ValueError, TypeError: this is no such checkpoint.
    """
    own = under("in_site", arrays)
    rows = zip(own["links"].tolist(), own["poses"], own["covariances"], strict=True)
    links = [
        BaseLink(keyframe, base_keyframe, sub_map, to_sim3(pose), covariance, inliers)
        for (keyframe, base_keyframe, sub_map, inliers), pose, covariance in rows
    ]
    first = None if facts["first"] is None else FirstRecognised(*facts["first"])
    in_base.resume(links, first, facts["counts"])
