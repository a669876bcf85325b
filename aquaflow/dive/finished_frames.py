"""The frames of a finished dive with what is known of each: class, pose, time, navigation."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.dive.frames_csv import FrameRow, read_rows
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow, read_trajectory_csv
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.metric_file import read_main

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


def read_finished_frames(dive: Path) -> list[FinishedFrame]:
    """Every frame that was asked for, in the order of the recording; poses and what is known of
    them only of the largest sub-map, whose world the map's is.

    Raises:
        InputError: a file is missing or damaged.
    """
    rows, main = read_rows(dive / "frames.csv"), read_main(dive)
    path = read_tum(dive / "trajectory.tum", inside=True)
    poses = {
        _ns(float(t)): Sim3(R, position)
        for t, R, position in zip(path.t_s, path.R_wc, path.positions, strict=True)
    }
    table = dive / TRAJECTORY_CSV
    known = {row.index: row for row in read_trajectory_csv(table)} if table.is_file() else {}
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


def read_facts(path: Path) -> dict[str, Any]:
    """A JSON object of the dive, such as ``metrics.json``; empty where there is no such file.

    Raises:
        InputError: it is damaged.
    """
    if not path.is_file():
        return {}
    try:
        facts = read_regular_json(path)
        if not isinstance(facts, dict):
            raise DamagedError("it is no JSON object")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
    return facts


def start_ns(metrics: dict[str, Any]) -> int | None:
    """UTC of the recording's first frame, ns since 1970; None where nothing stated it."""
    said = metrics.get("utc_start")
    if said is None:
        return None
    begun = datetime.fromisoformat(str(said).replace("Z", "+00:00"))
    whole = begun.replace(microsecond=0)
    return int(whole.timestamp()) * NS + begun.microsecond * 1000
