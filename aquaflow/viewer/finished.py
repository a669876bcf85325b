"""A finished dive in the viewer: ``aquaflow view DIVE``."""

from __future__ import annotations

import contextlib
import csv
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import DamagedError, InputError, reason_of
from aquaflow.export.ply import read_ply
from aquaflow.fusion.metric_file import read_frame_of_map
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3, rotation_from_quaternion
from aquaflow.viewer.dive_coverage import CLASSES, COVERAGE, coverage_of_dive
from aquaflow.viewer.dive_moments import moments_of_dive, pictures_of_dive
from aquaflow.viewer.exhibit import POSE_NUMBERS
from aquaflow.viewer.levels import RANGE, Palette, range_level
from aquaflow.viewer.measuring import Asked, Frame
from aquaflow.viewer.page import ViewerPage
from aquaflow.viewer.pinned_notes import PinnedNotes
from aquaflow.viewer.scale_tool import Mark, marked
from aquaflow.viewer.seen_water import SeenWater, water_of
from aquaflow.viewer.splats import Splats, splats
from aquaflow.viewer.tools import SCALE, Tools

log = logging.getLogger(__name__)

LONGEST_PATH = 5000
"""Most poses that a page gets, as of a live dive: 52 bytes each, on their way before the map."""
TUM_COLUMNS = 8
"""t_s tx ty tz qx qy qz qw"""


@dataclass(frozen=True)
class FinishedDive:
    """What the viewer shows of a dive folder."""

    splats: Splats
    water: SeenWater | None
    palettes: dict[str, Palette]
    poses: list[Sim3]
    quality: npt.NDArray[np.float64]
    """[N] inlier share of each pose."""
    moments: npt.NDArray[np.float32]
    """[N, 5] of each pose, as :mod:`aquaflow.viewer.moments` has them."""
    began: datetime | None
    """UTC of the first pose, if it is known."""
    pictures: dict[int, Path]
    """What the camera saw, by the frame's index, where the dive keeps it."""
    camera: CameraModel
    summary: str
    frame: MetricFrame


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
    quality, indices = _of_frames(folder, times)
    pictures = pictures_of_dive(folder)
    moments, began = moments_of_dive(folder, times, indices, pictures)
    frame, camera = read_frame_of_map(folder / "map.aqf"), load_camera(folder / "camera.yaml")
    water = _water(folder / "medium.json")
    clear = folder / "map_clear.ply"
    if water is None or not clear.is_file():  # colours with the water in them are all there is
        water, clear = None, folder / "map.ply"
    gaussians = read_ply(clear)
    cameras = np.array([pose.t for pose in poses]).reshape(-1, 3)
    levels, palettes = _levels(gaussians.means, cameras, frame.unit)
    classes = coverage_of_dive(folder, gaussians.means, frame)
    if classes is not None:
        levels[COVERAGE], palettes[COVERAGE] = classes, CLASSES
    shown = splats(
        np.asarray(gaussians.means, np.float32), np.asarray(gaussians.wxyz, np.float32),
        np.asarray(gaussians.scales, np.float32), np.asarray(gaussians.opacities, np.float32),
        np.asarray(gaussians.colours, np.float32), budget, levels,
    )  # fmt: skip
    of_all = f"{len(shown)} of {len(gaussians.means)} Gaussians"
    summary = f"{folder.name}: {len(poses)} poses, {of_all}\n\n{_frame_in_words(frame)}"
    return FinishedDive(
        shown, water, palettes, poses, quality, moments, began, pictures, camera, summary, frame
    )  # fmt: skip


def show_dive(dive: FinishedDive, config: ViewerConfig, tools: Tools | None = None) -> ViewerPage:
    """The viewer's page of ``dive``."""
    page = ViewerPage(config, "AquaFlow", live=False, tools=tools)
    fill(page, dive)
    return page


def fill(page: ViewerPage, dive: FinishedDive) -> None:
    """Show ``dive`` on ``page``, in place of what was there."""
    page.set_frame(
        Frame.of(dive.frame), up="-z" if dive.frame.level else "-y", north=dive.frame.north
    )
    page.show_health(dive.summary)
    page.show_splats(dive.splats, dive.water, dive.palettes)
    shown = thinned(dive.moments)
    page.show_path(rows_of(dive.poses, dive.quality)[shown], dive.moments[shown], dive.began)
    page.show_pictures(dive.pictures)
    if dive.poses:
        page.show_camera(dive.poses[0], dive.camera, None)


def open_dive(folder: Path, config: ViewerConfig, mark: Mark | None = None) -> ViewerPage:
    """The page of the finished dive in ``folder``, with its notes and, by ``mark``, its scale bar.

    Raises:
        InputError: there is no finished dive, or the address is taken.
        ConfigError: the token will not do.
    """
    tools = Tools(others=PinnedNotes(folder).tools())
    page: list[ViewerPage] = []

    def scale(given: Asked) -> Asked:
        said = marked(given, mark) if mark is not None else {}
        if said.get("rescaled"):
            fill(page[0], read_dive(folder, config.splats))
        return said

    if mark is not None:
        tools.others[SCALE] = scale
    page.append(show_dive(read_dive(folder, config.splats), config, tools))
    return page[0]


def thinned(
    moments: npt.NDArray[np.float32],  # [N, 5]
) -> npt.NDArray[np.intp]:
    """Numbers [M] of the poses that the page gets: at most ``LONGEST_PATH``."""
    step = max(1, -(-len(moments) // LONGEST_PATH))
    return np.arange(0, len(moments), step)


def rows_of(
    poses: Sequence[Sim3],
    quality: npt.NDArray[np.float64],  # [N]
) -> npt.NDArray[np.float32]:
    """[N, 8] as :meth:`ViewerPage.show_path` takes them."""
    rows = [[*T.t, *T.quaternion, q] for T, q in zip(poses, quality, strict=True)]
    return np.array(rows, np.float32).reshape(-1, POSE_NUMBERS)


def _levels(
    means: npt.NDArray[np.floating],  # [N, 3]
    cameras: npt.NDArray[np.float64],  # [M, 3]
    unit: str,
) -> tuple[dict[str, npt.NDArray[np.uint8]], dict[str, Palette]]:
    if not len(cameras) or not len(means):
        return {}, {}
    values, palette = range_level(means, cameras, unit)
    return {RANGE: values}, {RANGE: palette}


def _water(path: Path) -> SeenWater | None:
    """None for a dive without water, and for a file that does not say it."""
    try:
        return water_of(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, AttributeError, DamagedError) as error:
        log.warning("the viewer shows no water: %s: %s", path, reason_of(error))
        return None


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
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Quality and index of the frame at each time; -1 where there is none."""
    shown = _shown_by_microsecond(folder / "frames.csv")
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
