"""Every frame's pose in a component's world: a dive's trajectory, bent as its keyframes were."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import open_regular_text
from aquaflow.dive.tum import Trajectory, read_tum
from aquaflow.geometry.similarity import Sim3, quaternion_from_rotation
from aquaflow.geometry.similarity_batch import Sim3Batch

Array = npt.NDArray[np.float64]

FOLDER = "paths"
"""In a site: DIVE_COMPONENT.tum."""


def sub_maps_of_frames(dive: Path) -> dict[int, int]:
    """The sub-map of every posed frame, by its time in us.

    Raises:
        InputError: frames.csv cannot be read.
    """
    path = dive / "frames.csv"
    try:
        with open_regular_text(path) as stream:
            return {
                _microsecond(float(row["t_s"])): int(row["sub_map"])
                for row in csv.DictReader(stream)
                if row["sub_map"]
            }
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error


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


def path_of_sub_map(dive: Path, sub_map: int, sub_maps: dict[int, int]) -> Trajectory:
    """The part of a dive's trajectory that is in ``sub_map``, in n.

    Raises:
        InputError: it cannot be read.
    """
    path = read_tum(dive / "trajectory.tum", inside=True)
    there = [sub_maps.get(_microsecond(float(t))) == sub_map for t in path.t_s]
    return path.select(np.array(there, dtype=bool))


def _microsecond(t_s: float) -> int:
    return round(t_s * 1e6)
