"""What the evaluation takes from a dive: the poses of its largest sub-map."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.storage.table import text_of_cell
from aquaflow.dive.dive import FRAMES, Dive
from aquaflow.dive.tum import Trajectory

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


def evaluated_dive(dive: Dive) -> EvaluatedDive:
    """The poses of the largest sub-map (the earliest, if several are as large).

    Raises:
        InputError: a file is missing or malformed, or does not match the other.
    """
    if not dive.path.is_dir():
        raise InputError(
            f"there is no dive folder at {dive.path}; give the folder 'aquaflow map' wrote"
        )
    trajectory = dive.trajectory
    times, sources, sub_maps = _read_frames(dive.file(FRAMES))
    row_of_pose = dive.rows_of_poses(np.array(times))
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
