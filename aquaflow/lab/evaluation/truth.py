"""Ground truth on disk: a TUM file, a table of positions, or a synthetic dive's folder."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.lab.evaluation.trajectory_error import Trajectory, read_tum

SYNTHETIC_POSES = "poses.tum"
SYNTHETIC_MEDIUM = "medium.yaml"
SYNTHETIC_FACTS = "synth.yaml"
"""Files of a synthetic dive."""
POSITION_COLUMNS = ("file", "easting_m", "northing_m")
"""Of a survey's table of positions; metres in a projected grid such as UTM."""


@dataclass(frozen=True)
class PositionTable:
    """Horizontal position of named pictures, as a survey vehicle logs them."""

    files: list[str]
    positions: npt.NDArray[np.float64]
    """[N, 3] m: easting and northing from the first picture's, and zero for the unknown height."""


@dataclass(frozen=True)
class GroundTruth:
    """What a dive is compared with."""

    trajectory: Trajectory | None
    positions: PositionTable | None
    medium: Path | None
    """A synthetic dive's medium file, if there is one."""
    z_down: bool = False
    """True if the poses are those of a synthetic dive: in metres, z down."""


def read_truth(path: Path) -> GroundTruth:
    """Read a TUM file, a CSV of positions or a folder that holds a trajectory.

    Raises:
        InputError: nothing usable is there.
    """
    if path.is_dir():
        medium = path / SYNTHETIC_MEDIUM
        poses = _trajectory_in(path)
        known = medium if medium.is_file() else None
        return GroundTruth(read_tum(poses), None, known, _is_synthetic(poses))
    if not path.is_file():
        raise InputError(
            f"there is no ground truth at {path}; give a TUM file, a CSV of positions or a "
            "synthetic dive's folder"
        )
    if path.suffix.lower() == ".csv":
        return GroundTruth(None, read_positions(path), None)
    return GroundTruth(read_tum(path), None, None, _is_synthetic(path))


def _is_synthetic(poses: Path) -> bool:
    return poses.name == SYNTHETIC_POSES and poses.with_name(SYNTHETIC_FACTS).is_file()


def _trajectory_in(folder: Path) -> Path:
    """``poses.tum``, or the only TUM file in the folder."""
    if (folder / SYNTHETIC_POSES).is_file():
        return folder / SYNTHETIC_POSES
    found = sorted(folder.glob("*.tum"))
    if len(found) == 1:
        return found[0]
    raise InputError(
        f"{folder} holds {len(found)} TUM files and no {SYNTHETIC_POSES}; give the file itself"
    )


def read_positions(path: Path) -> PositionTable:
    """Read a CSV with the columns ``file``, ``easting_m`` and ``northing_m``; others are ignored.

    Positions count from the first row, because UTM coordinates of millions of metres would cost
    the alignment its digits.

    Raises:
        InputError: a column is missing, a number is malformed, or no row is left.
    """
    files: list[str] = []
    rows: list[tuple[float, float]] = []
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            missing = set(POSITION_COLUMNS) - set(reader.fieldnames or ())
            if missing:
                raise InputError(
                    f"{path} has no column {', '.join(sorted(missing))}; a table of positions "
                    f"needs {', '.join(POSITION_COLUMNS)}"
                )
            for row in reader:
                files.append(Path(row["file"]).name)
                rows.append(_metres(row, path, reader.line_num))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"cannot read the positions {path}: {reason_of(error)}; give a CSV file"
        ) from error
    if not rows:
        raise InputError(f"{path} holds no position; expected one row for each picture")
    plane = np.array(rows) - np.array(rows[0])
    return PositionTable(files, np.column_stack([plane, np.zeros(len(plane))]))


def _metres(row: dict[str, str], path: Path, number: int) -> tuple[float, float]:
    try:
        east, north = float(row["easting_m"]), float(row["northing_m"])
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path} line {number}: easting_m and northing_m must be numbers"
        ) from error
    if not (np.isfinite(east) and np.isfinite(north)):
        raise InputError(f"{path} line {number}: a position is not finite; remove this row")
    return east, north
