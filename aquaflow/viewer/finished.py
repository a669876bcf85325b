"""A finished dive in the viewer: ``aquaflow view DIVE``."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import InputError, reason_of
from aquaflow.export.ply import read_ply
from aquaflow.fusion.metric_file import read_frame_of_map
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3, rotation_from_quaternion
from aquaflow.viewer.page import ViewerPage
from aquaflow.viewer.splats import Splats, splats

TUM_COLUMNS = 8
"""t_s tx ty tz qx qy qz qw"""


@dataclass(frozen=True)
class FinishedDive:
    """What the viewer shows of a dive folder."""

    splats: Splats
    poses: list[Sim3]
    quality: npt.NDArray[np.float64]
    """[N] inlier share of each pose."""
    pictures: list[Path | None]
    """What the camera saw at each pose, where the dive keeps it."""
    camera: CameraModel
    summary: str
    level: bool = False
    """True if z points down, else y does, in the first camera."""


def _frame_in_words(frame: MetricFrame) -> str:
    unit = "Lengths are map units"
    if frame.metric:
        unit = f"Lengths are metres, \u00b1 {100.0 * frame.scale_sigma:.2g} %"
    return f"{unit}; x points to {frame.north}, z down" if frame.level else unit


def read_dive(folder: Path, budget: int) -> FinishedDive:
    """The finished dive in ``folder``.

    Raises:
        InputError: there is none.
    """
    for name in ("map.ply", "trajectory.tum", "camera.yaml", "frames.csv"):
        if not (folder / name).is_file():
            raise InputError(f"{folder} holds no finished dive: {name} is missing")
    poses, times = _poses(folder / "trajectory.tum")
    quality, pictures = _of_frames(folder, times)
    shown = _splats(folder, budget)
    frame = read_frame_of_map(folder / "map.aqf")
    summary = (
        f"**{folder.name}**\n\n{len(poses)} poses, {len(shown)} of the map's Gaussians\n\n"
        f"{_frame_in_words(frame)}"
    )
    return FinishedDive(
        shown, poses, quality, pictures, load_camera(folder / "camera.yaml"), summary, frame.level
    )


def show_dive(dive: FinishedDive, config: ViewerConfig) -> ViewerPage:
    """The viewer's page of ``dive``, with a slider along its path."""
    page = ViewerPage(config, "AquaFlow", up="-z" if dive.level else "-y")
    page.show_health(dive.summary)
    page.show_splats(dive.splats)
    page.show_path(np.array([pose.t for pose in dive.poses]).reshape(-1, 3), dive.quality)
    move = _mover(dive, page)
    if dive.poses:
        with_picture = [i for i, picture in enumerate(dive.pictures) if picture is not None]
        first = with_picture[len(with_picture) // 2] if with_picture else 0
        move(first)
        page.add_slider("Along the path", len(dive.poses), first, move)
    return page


def _mover(dive: FinishedDive, page: ViewerPage) -> Callable[[int], None]:
    def move(number: int) -> None:
        picture = dive.pictures[number]
        image = None if picture is None else _picture(picture)
        page.show_camera(dive.poses[number], dive.camera, image)

    return move


def _splats(folder: Path, budget: int) -> Splats:
    water = read_ply(folder / "map.ply")
    colours = {"water": np.asarray(water.colours, np.float32)}
    if (folder / "map_clear.ply").is_file():
        clear = read_ply(folder / "map_clear.ply")
        if len(clear.means) == len(water.means):
            colours["clear"] = np.asarray(clear.colours, np.float32)
    return splats(
        np.asarray(water.means, np.float32),
        np.asarray(water.wxyz, np.float32),
        np.asarray(water.scales, np.float32),
        np.asarray(water.opacities, np.float32),
        colours,
        budget,
    )


def _poses(path: Path) -> tuple[list[Sim3], npt.NDArray[np.float64]]:
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, TUM_COLUMNS)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
    if not np.isfinite(rows).all() or (np.linalg.norm(rows[:, 4:8], axis=1) == 0.0).any():
        raise InputError(f"{path} holds what is no pose; map the dive again")
    poses = [Sim3(rotation_from_quaternion(np.roll(row[4:8], 1)), row[1:4]) for row in rows]
    return poses, rows[:, 0]


def _of_frames(
    folder: Path,
    times: npt.NDArray[np.float64],  # [N] s
) -> tuple[npt.NDArray[np.float64], list[Path | None]]:
    """Quality and picture of the frame at each time."""
    shown = _shown_by_microsecond(folder / "frames.csv")
    quality, pictures = [], []
    for t_s in times:
        inliers, index = shown.get(_microsecond(t_s), (1.0, 0))
        quality.append(inliers)
        picture = folder / "heldout" / f"{index:06d}_real.png"
        pictures.append(picture if picture.is_file() else None)
    return np.array(quality), pictures


def _shown_by_microsecond(path: Path) -> dict[int, tuple[float, int]]:
    """Quality and index of the frame at each time; a damaged line is skipped."""
    shown: dict[int, tuple[float, int]] = {}
    try:
        with path.open(newline="", encoding="utf-8", errors="replace") as stream:
            for row in csv.DictReader(stream):
                with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):
                    found = float(row["quality"] or 1.0), int(row["index"])
                    shown[_microsecond(float(row["t_s"]))] = found
    except (OSError, csv.Error) as error:
        raise InputError(f"cannot read {path}; map the dive again") from error
    return shown


def _microsecond(t_s: float) -> int:
    return round(float(t_s) * 1e6)


def _picture(path: Path) -> npt.NDArray[np.uint8] | None:
    import cv2

    image = cv2.imread(str(path))
    return None if image is None else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
