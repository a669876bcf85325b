"""What a dive keeps at its end so that its places can be recognised another day."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.keyframes.place import KeypointDepths, Place, depths_at
from aquaflow.keyframes.places_file import EDGE, NAME, Rows, write_places
from aquaflow.slam import Slam
from aquaflow.tracking.graph.table import Snapshot

log = logging.getLogger(__name__)


def write_places_of(dive: Path, slam: Slam, poses: Mapping[int, Sim3]) -> None:
    """places.npz in the folder of a dive; ``poses``: T_mc by frame index, as the map refined them.

    One keyframe at a time is in memory; one that cannot be read back costs itself. A dive without
    keyframes gets no file.

    Raises:
        InputError: the file cannot be written.
    """
    if slam.keyframes.readable:
        write_places(dive / NAME, _places(slam.keyframes, poses), _edges(slam.graph.snapshot))


def _places(
    keyframes: KeyframeStore, poses: Mapping[int, Sim3]
) -> Iterator[tuple[Place, KeypointDepths]]:
    for keyframe in keyframes.readable:
        try:
            yield (
                _place(keyframe, poses),
                depths_at(keyframe.encoding.keypoints, keyframe.pointmap),
            )
        except InputError as error:
            log.warning("keyframe %d is not in %s: %s", keyframe.number, NAME, error)


def _place(keyframe: Keyframe, poses: Mapping[int, Sim3]) -> Place:
    T_wc = keyframe.T_wc
    refined = poses.get(keyframe.frame_index, T_wc)
    return Place(
        keyframe.number,
        keyframe.frame_index,
        keyframe.sub_map,
        keyframe.t_ns,
        Sim3(refined.R, refined.t, T_wc.scale),
        keyframe.pointmap.camera,
    )


def _edges(graph: Snapshot) -> Rows:
    """[E] EDGE"""
    rows = np.zeros(len(graph.edges), EDGE)
    for end in ("a", "b"):
        rows[end] = graph.nodes["number"][graph.edges[end]]
    for name in ("R", "t", "scale", "information", "loop"):
        rows[name] = graph.edges[name]
    rows["trust"] = graph.trust["trust"]
    return rows
