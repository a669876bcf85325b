"""A finished dive as plain data: frames, poses, camera, medium, metrics."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.dive.frames_csv import FrameRow, read_rows
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow, read_trajectory_csv
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.lab.evaluation.dive_files import read_metrics, rows_of_poses
from aquaflow.lab.evaluation.medium import read_recovered
from aquaflow.lab.evaluation.trajectory import Trajectory, read_tum
from aquaflow.lab.synthetic.water import Medium
from aquaflow.telemetry.metric_file import read_metric_file
from aquaflow.telemetry.metric_frame import MetricFrame


@dataclass(frozen=True)
class Dive:
    """What is in a dive folder.

    Where telemetry gave metres and gravity, the world is n: x to north or along the initial
    heading, y to the right of it, z down, metres. Else it is the camera of the first keyframe (x
    right, y down, z forward), and the unit of length is the map unit, the median depth of that
    keyframe; such sub-maps share neither origin nor unit unless they met.
    """

    path: Path
    frames: list[FrameRow]
    """Every frame of the recording that was asked for, in the recording's order."""
    trajectory: Trajectory
    """P poses, camera to world: positions in ``unit``, times in s since the first frame."""
    frame_of_pose: npt.NDArray[np.intp]
    """[P] number of each pose's row in ``frames``."""
    camera: CameraModel
    """The pinhole camera of the mapped pictures, pixels."""
    medium: Medium | None
    """The water of the largest sub-map, with rates per ``unit``; None if none is modelled."""
    metrics: dict[str, Any]
    """``metrics.json``: counts, quality on held-out frames, times in ms, memory in MB."""
    metric_frames: dict[int, MetricFrame]
    """By sub-map: what its world is, how well that is known, and from which telemetry; empty for a
    dive that was mapped by an older AquaFlow."""

    @property
    def unit(self) -> str:
        """Of lengths in the largest sub-map: ``m`` or ``map units``."""
        return str(self.metrics.get("unit", MetricFrame.unknown().unit))

    @property
    def sub_map_of_pose(self) -> npt.NDArray[np.intp]:
        """[P] number of the sub-map that each pose belongs to; -1 where the table has none."""
        numbers = [self.frames[row].sub_map for row in self.frame_of_pose]
        return np.array([-1 if number is None else number for number in numbers], np.intp)

    def navigation(self) -> list[PoseRow]:
        """Each pose with what telemetry says of it: UTC, depth, attitude, place on the earth.

        Raises:
            InputError: ``trajectory.csv`` is missing, as in dives of an older AquaFlow, or damaged.
        """
        return read_trajectory_csv(self.path / TRAJECTORY_CSV)

    def __len__(self) -> int:
        """Number of frames, posed or not."""
        return len(self.frames)


def read_dive(path: str | os.PathLike[str]) -> Dive:
    """Read the finished dive in the folder ``path``.

    Raises:
        InputError: the dive is not finished, or a file is missing or malformed, or does not match
            another.
        ConfigError: ``camera.yaml`` is malformed.
    """
    folder = Path(path)
    refuse_unfinished(folder)
    frames = read_rows(folder / "frames.csv")
    trajectory = read_tum(folder / "trajectory.tum", inside=True)
    times_s = np.array([row.t_s for row in frames])
    medium, active = None, False
    if (folder / "medium.json").is_file():
        medium, active = read_recovered(folder / "medium.json", metres_per_unit=1.0)
    return Dive(
        path=folder,
        frames=frames,
        trajectory=trajectory,
        frame_of_pose=rows_of_poses(folder, trajectory, times_s),
        camera=load_camera(folder / "camera.yaml", inside=True),
        medium=medium if active else None,
        metrics=read_metrics(folder),
        metric_frames=read_metric_file(folder),
    )
