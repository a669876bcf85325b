"""A finished dive in the viewer: ``aquaflow view DIVE``."""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import DamagedError, InputError, reason_of
from aquaflow.fusion.metric_file import read_frame_of_map
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3, rotation_from_quaternion
from aquaflow.viewer.dive_map import DiveMap, read_map
from aquaflow.viewer.dive_moments import moments_of_dive, pictures_of_dive
from aquaflow.viewer.exhibit import POSE_NUMBERS
from aquaflow.viewer.levels import Palette
from aquaflow.viewer.measuring import Asked, Frame
from aquaflow.viewer.packed_file import PackedFile, key_of, read_packed, write_packed
from aquaflow.viewer.page import ViewerPage
from aquaflow.viewer.pinned_notes import PinnedNotes
from aquaflow.viewer.scale_tool import Mark, marked
from aquaflow.viewer.seen_water import SeenWater, water_of
from aquaflow.viewer.splats import Splats
from aquaflow.viewer.tools import SCALE, Tools

log = logging.getLogger(__name__)

LONGEST_PATH = 5000
"""Most poses that a page gets, as of a live dive: 52 bytes each, on their way before the map."""
TUM_COLUMNS = 8
"""t_s tx ty tz qx qy qz qw"""


@dataclass(frozen=True)
class FinishedDive:
    """What the viewer shows of a dive folder."""

    name: str
    map: Callable[[], DiveMap]
    """Reads the Gaussians when it is first called."""
    packed: PackedFile | None
    """Of an earlier look: then a browser needs no :attr:`map` to see them."""
    key: dict[str, Any]
    """Of a packed map of this dive as it is now."""
    water: SeenWater | None
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
    frame: MetricFrame

    @property
    def splats(self) -> Splats:
        """The Gaussians that are shown."""
        return self.map().splats

    @property
    def palettes(self) -> dict[str, Palette]:
        """Of the splats' levels."""
        return self.map().palettes if self.packed is None else self.packed.palettes

    @property
    def summary(self) -> str:
        """For the panel: paragraphs."""
        if self.packed is None:
            count, total = len(self.map().splats), self.map().total
        else:
            count, total = self.packed.count, self.packed.total
        of_all = f"{len(self.poses)} poses, {count} of {total} Gaussians"
        return f"{self.name}: {of_all}\n\n{_frame_in_words(self.frame)}"


def _frame_in_words(frame: MetricFrame) -> str:
    unit = "Lengths are map units"
    if frame.metric:
        unit = f"Lengths are metres, \u00b1 {100.0 * frame.scale_sigma:.2g} %"
    return f"{unit}; x points to {frame.north}, z down" if frame.level else unit


def read_dive(folder: Path, budget: int) -> FinishedDive:
    """The finished dive in ``folder``; its Gaussians are read when they are asked for.

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
    cameras = np.array([pose.t for pose in poses]).reshape(-1, 3)
    key = key_of(folder, budget)
    return FinishedDive(
        folder.name, cache(partial(read_map, folder, clear, cameras, frame, budget)),
        read_packed(folder, key), key, water, poses, quality, moments, began, pictures, camera,
        frame,
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
    if dive.packed is not None:
        page.show_packed(dive.packed, lambda: dive.splats, dive.water, dive.palettes)
    else:
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
    dive = read_dive(folder, config.splats)
    page.append(show_dive(dive, config, tools))
    prepare(folder, dive, page[0])
    return page[0]


def prepare(folder: Path, dive: FinishedDive, page: ViewerPage) -> threading.Thread:
    """Behind the page: the Gaussians are read, for who points at them, or their packing is kept."""

    def work() -> None:
        try:
            packed = page.packed
            if dive.packed is not None:
                dive.map()
            elif packed is not None:
                write_packed(folder, dive.key, packed, dive.palettes, dive.map().total)
        except InputError as error:  # who points is told so
            log.warning("%s", error)

    thread = threading.Thread(target=work, name="viewer's map", daemon=True)
    thread.start()
    return thread


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
