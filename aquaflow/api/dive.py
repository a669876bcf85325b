"""A finished dive as plain data: frames, poses, camera, medium, metrics."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.frames_csv import FrameRow, read_rows
from aquaflow.evaluation.dive_files import read_metrics, rows_of_poses
from aquaflow.evaluation.medium import read_recovered
from aquaflow.evaluation.trajectory import Trajectory, read_tum
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.synthetic.water import Medium


@dataclass(frozen=True)
class Dive:
    """What is in a dive folder.

    The world is the camera of the first keyframe: x right, y down, z forward. The unit of length is
    the map unit, the median depth of that keyframe; one camera cannot know metres. Sub-maps that
    never met share neither origin nor unit.
    """

    path: Path
    frames: list[FrameRow]
    """Every frame of the recording that was asked for, in the recording's order."""
    trajectory: Trajectory
    """P poses, camera to world: positions in map units, times in s since the first frame."""
    frame_of_pose: npt.NDArray[np.intp]
    """[P] number of each pose's row in ``frames``."""
    camera: CameraModel
    """The pinhole camera of the mapped pictures, pixels."""
    medium: Medium | None
    """The water of the largest sub-map, with rates per map unit; None if none is modelled."""
    metrics: dict[str, Any]
    """``metrics.json``: counts, quality on held-out frames, times in ms, memory in MB."""

    @property
    def sub_map_of_pose(self) -> npt.NDArray[np.intp]:
        """[P] number of the sub-map that each pose belongs to; -1 where the table has none."""
        numbers = [self.frames[row].sub_map for row in self.frame_of_pose]
        return np.array([-1 if number is None else number for number in numbers], np.intp)

    def __len__(self) -> int:
        """Number of frames, posed or not."""
        return len(self.frames)


def read_dive(path: str | os.PathLike[str]) -> Dive:
    """Read the finished dive in the folder ``path``.

    Raises:
        InputError: a file is missing or malformed, or does not match another.
        ConfigError: ``camera.yaml`` is malformed.
    """
    folder = Path(path)
    frames = read_rows(folder / "frames.csv")
    trajectory = read_tum(folder / "trajectory.tum")
    times_s = np.array([row.t_s for row in frames])
    medium, active = None, False
    if (folder / "medium.json").is_file():
        medium, active = read_recovered(folder / "medium.json", metres_per_unit=1.0)
    return Dive(
        path=folder,
        frames=frames,
        trajectory=trajectory,
        frame_of_pose=rows_of_poses(folder, trajectory, times_s),
        camera=load_camera(folder / "camera.yaml"),
        medium=medium if active else None,
        metrics=read_metrics(folder),
    )
