"""The frames of a finished dive with what is known of each: class, pose, time, navigation."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from aquaflow.dive.dive import Dive
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import Sim3

NS = 1_000_000_000


@dataclass(frozen=True)
class FinishedFrame:
    """A frame of the recording."""

    row: FrameRow
    t_ns: int
    """Since the recording's first frame."""
    T_nc: Sim3 | None
    """Camera to n; None without a pose in the largest sub-map."""
    known: PoseRow | None
    """Of a frame with such a pose, in a dive that has trajectory.csv."""


def read_finished_frames(dive: Dive) -> list[FinishedFrame]:
    """Every frame that was asked for, in the order of the recording; poses and what is known of
    them only of the largest sub-map, whose world the map's is.

    Raises:
        InputError: a file is missing or damaged.
    """
    rows, main, path = dive.frames, dive.main, dive.trajectory
    poses = {
        _ns(float(t)): Sim3(R, position)
        for t, R, position in zip(path.t_s, path.R_wc, path.positions, strict=True)
    }
    known = {row.index: row for row in dive.poses} if dive.has(TRAJECTORY_CSV) else {}
    frames = []
    for row in sorted(rows, key=lambda row: row.t_s):
        t_ns, placed = _ns(row.t_s), row.sub_map == main
        frames.append(
            FinishedFrame(
                row, t_ns, poses.get(t_ns) if placed else None,
                known.get(row.index) if placed else None,
            )
        )  # fmt: skip
    return frames


def _ns(t_s: float) -> int:
    return round(t_s * NS)


def start_ns(metrics: dict[str, Any]) -> int | None:
    """UTC of the recording's first frame, ns since 1970; None where nothing stated it."""
    said = metrics.get("utc_start")
    if said is None:
        return None
    begun = datetime.fromisoformat(str(said).replace("Z", "+00:00"))
    whole = begun.replace(microsecond=0)
    return int(whole.timestamp()) * NS + begun.microsecond * 1000
