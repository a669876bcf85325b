"""What the evaluation reads of a dive folder: poses, the table of frames, the run's metrics."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.table import text_of_cell
from aquaflow.lab.evaluation.trajectory import Trajectory, associate, read_tum

ROW_TOLERANCE_S = 1e-3
"""``trajectory.tum`` and ``frames.csv`` may round a time differently; frames are further apart."""

FRAME_COLUMNS = ("index", "source", "t_s", "class", "sub_map")
"""Columns that the evaluation needs; peers in the benchmark write no others."""


@dataclass(frozen=True)
class EvaluatedDive:
    """The largest sub-map of a dive, and what it leaves out."""

    frames: int
    """Rows of ``frames.csv``."""
    posed: int
    """Frames with a pose, in any sub-map."""
    trajectory: Trajectory
    """Of the largest sub-map."""
    sources: list[str]
    """[N] the source's name of each of its poses."""
    sub_map: int
    sub_maps: int
    """Number of sub-maps with a pose."""

    @property
    def left_out(self) -> int:
        """Poses in other sub-maps: they have no common frame with the one that is evaluated."""
        return self.posed - len(self.trajectory)


def read_dive(dive: Path) -> EvaluatedDive:
    """Read the poses of the largest sub-map (the earliest, if several are as large).

    Raises:
        InputError: a file is missing or malformed, or does not match the other.
    """
    if not dive.is_dir():
        raise InputError(f"there is no dive folder at {dive}; give the folder 'aquaflow map' wrote")
    trajectory = read_tum(dive / "trajectory.tum")
    times, sources, sub_maps = _read_frames(dive / "frames.csv")
    row_of_pose = rows_of_poses(dive, trajectory, np.array(times))
    members = [sub_maps[row] for row in row_of_pose]
    largest, _ = Counter(members).most_common(1)[0]
    chosen = np.array([member == largest for member in members])
    return EvaluatedDive(
        frames=len(times),
        posed=len(trajectory),
        trajectory=trajectory.select(chosen),
        sources=[sources[row_of_pose[i]] for i in np.flatnonzero(chosen)],
        sub_map=largest,
        sub_maps=len(set(members)),
    )


def rows_of_poses(
    dive: Path,
    trajectory: Trajectory,
    times_s: npt.NDArray[np.float64],  # [F] s, of the rows of frames.csv
) -> npt.NDArray[np.intp]:
    """[N] the row of frames.csv that each pose belongs to, found by its time.

    Raises:
        InputError: a pose has no row.
    """
    order = np.argsort(times_s, kind="stable")
    poses, rows = associate(trajectory.t_s, times_s[order], ROW_TOLERANCE_S)
    if len(poses) < len(trajectory):
        raise InputError(
            f"{dive}: {len(trajectory) - len(poses)} of {len(trajectory)} poses in trajectory.tum "
            "have no row in frames.csv; both must come from the same run"
        )
    return order[rows]


def _read_frames(path: Path) -> tuple[list[float], list[str], list[int]]:
    """Times (s), sources and sub-maps of every row; -1 where a frame is in no sub-map."""
    times: list[float] = []
    sources: list[str] = []
    sub_maps: list[int] = []
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            missing = set(FRAME_COLUMNS) - set(reader.fieldnames or ())
            if missing:
                raise InputError(
                    f"{path} has no column {', '.join(sorted(missing))}; run 'aquaflow map' again"
                )
            for row in reader:
                try:
                    times.append(float(row["t_s"]))
                    sub_maps.append(int(row["sub_map"] or -1))
                except (TypeError, ValueError) as error:
                    raise InputError(
                        f"{path} line {reader.line_num}: t_s and sub_map must be numbers"
                    ) from error
                sources.append(text_of_cell(row["source"]))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read the frames {path}; run 'aquaflow map' again") from error
    return times, sources, sub_maps


def read_metrics(dive: Path) -> dict[str, Any]:
    """The run's ``metrics.json``; empty if the run was stopped before it was written.

    Raises:
        InputError: the file is there but is not a JSON object.
    """
    path = dive / "metrics.json"
    if not path.exists():
        return {}
    try:
        data = read_regular_json(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is not JSON; run 'aquaflow map' again") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} holds no JSON object; run 'aquaflow map' again")
    return data
