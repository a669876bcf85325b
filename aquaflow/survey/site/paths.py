"""Every frame's pose in a component's world: a dive's trajectory, bent as its keyframes were."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.dive.dive import Dive
from aquaflow.dive.tum import Trajectory
from aquaflow.geometry.similarity import Sim3, Sim3Batch, quaternion_from_rotation

Array = npt.NDArray[np.float64]

FOLDER = "paths"
"""In a site: DIVE_COMPONENT.tum."""


def sub_maps_of_frames(dive: Dive) -> dict[int, int]:
    """The sub-map of each posed frame by its time, microseconds.

    Raises:
        InputError: the table of frames cannot be read.
    """
    return {_microsecond(row.t_s): row.sub_map for row in dive.frames if row.sub_map is not None}


def moved_path(
    path: Trajectory,
    times_s: Array,  # [K] of the keyframes, increasing
    before: Sequence[Sim3],
    after: Sequence[Sim3],
) -> Trajectory:
    """The poses of ``path``, each moved as the keyframes before and after it were.

    Between two keyframes the moves are interpolated along the similarity that takes one to the
    other; before the first and after the last that one's move is used.
    """
    moves = Sim3Batch.of(after) @ Sim3Batch.of(before).inverse()
    last = np.clip(np.searchsorted(times_s, path.t_s, side="right"), 1, len(times_s)) - 1
    following = np.minimum(last + 1, len(times_s) - 1)
    span = times_s[following] - times_s[last]
    share = np.where(span > 0.0, (path.t_s - times_s[last]) / np.where(span > 0.0, span, 1.0), 0.0)
    start = moves[last]
    way = (start.inverse() @ moves[following]).log()
    move = start @ Sim3Batch.exp(np.clip(share, 0.0, 1.0)[:, None] * way)
    positions = move.scale[:, None] * np.einsum("nij,nj->ni", move.R, path.positions) + move.t
    return Trajectory(path.t_s, positions, quaternion_from_rotation(move.R @ path.R_wc))


def path_of_sub_map(dive: Dive, sub_map: int, sub_maps: dict[int, int]) -> Trajectory:
    """The part of a dive's trajectory that is in ``sub_map``, in n.

    Raises:
        InputError: it cannot be read.
    """
    path = dive.trajectory
    there = [sub_maps.get(_microsecond(float(t))) == sub_map for t in path.t_s]
    return path.select(np.array(there, dtype=bool))


def _microsecond(t_s: float) -> int:
    return round(t_s * 1e6)
