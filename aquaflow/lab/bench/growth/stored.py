"""Bytes that a dive takes on the disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.base.storage.facts_file import write_facts_file
from aquaflow.geometry.arrays import Arrays, of_sim3, prefixed
from aquaflow.mapping import state
from aquaflow.slam import Slam


def folder_bytes(folder: Path) -> int:
    """Of all files in ``folder`` and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def checkpoint_bytes(slam: Slam, scratch: Path) -> int:
    """Of what a live dive's checkpoint would hold now; written to the file ``scratch``, which is
    removed again.

    Raises:
        InputError: it cannot be written.
    """
    facts, arrays = {}, _of_tracking(slam)
    for number, mapper in slam.mappers.items():
        facts[str(number)], parts = state.serialise(mapper, optimiser=True)
        arrays |= prefixed(f"map{number}", parts)
    try:
        write_facts_file(scratch, facts, arrays)
        return scratch.stat().st_size
    finally:
        scratch.unlink(missing_ok=True)


def _of_tracking(slam: Slam) -> Arrays:
    keyframes = slam.keyframes.keyframes
    return {
        "frames": slam.frames.rows(),
        "keyframes": np.array([(k.frame_index, k.t_ns, k.sub_map, 0, 0) for k in keyframes]),
        "poses": of_sim3([keyframe.T_wc for keyframe in keyframes]),
        **prefixed("graph", dict(slam.graph.graph.tables())),
    }
