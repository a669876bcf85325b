"""The path of a finished dive as the viewer shows it: poses, how well each is known, and when."""

from __future__ import annotations

import contextlib
import csv
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import open_regular_text
from aquaflow.dive.dive import FRAMES, HELD_OUT, TRAJECTORY, Dive
from aquaflow.dive.trajectory_csv import NAME as PATH_TABLE
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import Sim3, quaternion_from_rotation, rotation_from_quaternion
from aquaflow.recordings.kept_pictures import kept_pictures
from aquaflow.survey.viewer.moments import Float, moments
from aquaflow.survey.viewer.viewer_content import POSE_NUMBERS

LONGEST_PATH = 5000
"""Most poses that a page gets, as of a live dive: 52 bytes each, on their way before the map."""
TUM_COLUMNS = 8
"""t_s tx ty tz qx qy qz qw"""


@dataclass(frozen=True)
class DivePath:
    """N poses, and the pictures that were kept on the way."""

    t_s: npt.NDArray[np.float64]
    """[N] as in trajectory.tum."""
    poses: list[Sim3]
    """T_nc"""
    quality: npt.NDArray[np.float64]
    """[N] inlier share of each pose."""
    moments: npt.NDArray[np.float32]
    """[N, 5] of each pose, as :mod:`aquaflow.survey.viewer.moments` has them."""
    began: datetime | None
    """UTC of the first pose, if it is known."""
    pictures: dict[int, Path]
    """What the camera saw, by the frame's index, where the dive keeps it."""

    @property
    def places(self) -> npt.NDArray[np.float64]:
        """[N, 3] of the camera."""
        return np.array([pose.t for pose in self.poses]).reshape(-1, 3)

    @property
    def rows(self) -> npt.NDArray[np.float32]:
        """[N, 8] as :meth:`aquaflow.survey.viewer.page.ViewerPage.show_path` takes them."""
        if not self.poses:
            return np.zeros((0, POSE_NUMBERS), np.float32)
        wxyz = quaternion_from_rotation(np.array([pose.R for pose in self.poses]))
        return np.column_stack([self.places, wxyz, self.quality]).astype(np.float32)

    def thin(self, most: int = LONGEST_PATH) -> DivePath:
        """Every n-th pose, so that they are at most ``most``."""
        step = max(1, -(-len(self.poses) // most))
        return self.among(range(0, len(self.poses), step))

    def among(self, numbers: Sequence[int]) -> DivePath:
        """Only the poses with these numbers."""
        chosen = np.asarray(numbers, np.intp)
        return replace(
            self, t_s=self.t_s[chosen], poses=[self.poses[i] for i in chosen],
            quality=self.quality[chosen], moments=self.moments[chosen],
        )  # fmt: skip


def read_path(dive: Dive) -> DivePath:
    """The path of a finished dive.

    Raises:
        InputError: a file cannot be read, or holds something else.
    """
    poses, t_s = _poses(dive.file(TRAJECTORY))
    quality, indices = _of_frames(dive, t_s)
    pictures = pictures_of_dive(dive)
    moments, began = moments_of_dive(dive, t_s, indices, pictures)
    return DivePath(t_s, poses, quality, moments, began, pictures)


def _poses(path: Path) -> tuple[list[Sim3], npt.NDArray[np.float64]]:
    try:
        with open_regular_text(path) as stream:
            rows = np.loadtxt(stream, ndmin=2).reshape(-1, TUM_COLUMNS)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
    if not np.isfinite(rows).all() or (np.linalg.norm(rows[:, 4:8], axis=1) == 0.0).any():
        raise InputError(f"{path} holds what is no pose; map the dive again")
    rotations = rotation_from_quaternion(rows[:, [7, 4, 5, 6]])
    poses = [Sim3(R, t) for R, t in zip(rotations, rows[:, 1:4], strict=True)]
    return poses, rows[:, 0]


def _of_frames(
    dive: Dive,
    times: npt.NDArray[np.float64],  # [N] s
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Quality and index of the frame at each time; -1 where there is none."""
    shown = _shown_by_microsecond(dive.file(FRAMES))
    quality, indices = [], []
    for t_s in times:
        inliers, index = shown.get(_microsecond(t_s), (1.0, -1))
        quality.append(inliers)
        indices.append(index)
    return np.array(quality), np.array(indices, np.int64)


def _shown_by_microsecond(path: Path) -> dict[int, tuple[float, int]]:
    """Quality and index of the frame at each time; a damaged line is skipped."""
    shown: dict[int, tuple[float, int]] = {}
    try:
        with open_regular_text(path, errors="replace") as stream:
            for row in csv.DictReader(stream):
                with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):
                    found = float(row["quality"] or 1.0), int(row["index"])
                    shown[_microsecond(float(row["t_s"]))] = found
    except (OSError, csv.Error) as error:
        raise InputError(f"cannot read {path}; map the dive again") from error
    return shown


def _microsecond(t_s: float) -> int:
    return round(float(t_s) * 1e6)


# --------------------------------------------------------------------------------------------------
# The moments of a finished dive's poses, from trajectory.csv, and the pictures that it keeps.

log = logging.getLogger(__name__)


def pictures_of_dive(dive: Dive) -> dict[int, Path]:
    """What the camera saw, by the frame's index: the held-out pictures and the small ones."""
    found = kept_pictures(dive.path)
    for path in dive.file(HELD_OUT).glob("*_real.png"):
        number = path.name.removesuffix("_real.png")
        if path.is_symlink() or path.parent.is_symlink():
            continue
        if number.isascii() and number.isdecimal():
            found[int(number)] = path
    return found


def moments_of_dive(
    dive: Dive,
    t_s: npt.NDArray[np.float64],  # [N] of the poses in trajectory.tum
    index: npt.NDArray[np.int64],  # [N] of their frames, -1 where not known
    kept: Iterable[int],
) -> tuple[Float, datetime | None]:
    """[N, 5] as :func:`aquaflow.survey.viewer.moments.moments` gives them, and the UTC of the
    first pose, if it is known."""
    table = _table(dive)
    rows = [table.get(round(float(each) * 1e6)) for each in t_s]
    depth = np.array([_or_nan(row.depth_m if row else None) for row in rows], np.float64)
    heading = np.array([_or_nan(row.heading_deg if row else None) for row in rows], np.float64)
    began = None
    for row in rows:
        if row is not None and row.utc is not None:
            began = row.utc - timedelta(seconds=row.t_s - float(t_s[0]))
            break
    return moments(t_s, depth, heading, index, kept), began


def _table(dive: Dive) -> dict[int, PoseRow]:
    """By microsecond; nothing where there is no such file, or one of another version."""
    if not dive.has(PATH_TABLE):
        return {}
    try:
        return {round(row.t_s * 1e6): row for row in dive.poses}
    except InputError as error:
        log.warning("the viewer shows neither depth nor heading: %s", error)
        return {}


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
