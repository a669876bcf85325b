"""A dive as it lies in its folder: the one reader of its files (docs/formats.md#dive-folder)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, printable, reason_of
from aquaflow.base.errors.regular_file import open_regular_text, read_regular_json
from aquaflow.base.storage import dive_status
from aquaflow.base.storage.dive_status import DiveStatus, read_status, refuse_unfinished
from aquaflow.config import Config, load_config
from aquaflow.dive.fixes_csv import NAME as FIXES
from aquaflow.dive.fixes_csv import FixRow, read_fixes_csv
from aquaflow.dive.frames_csv import FrameRow, read_rows
from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.dive.medium import Medium, medium_of
from aquaflow.dive.png import read_png
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow, read_trajectory_csv
from aquaflow.dive.tum import Trajectory, associate, read_tum
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.keyframes.place import NAME as PLACES
from aquaflow.keyframes.place import PlacesFile
from aquaflow.telemetry.metric_file import map_name, read_main, read_metric_file
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.render.views import View

FRAMES, METRICS, MAP = dive_status.FRAMES, dive_status.METRICS, dive_status.MAP
TRAJECTORY = "trajectory.tum"
CAMERA, CALIBRATION, CONFIG = "camera.yaml", "calibration.yaml", "config.yaml"
HELD_OUT = "heldout"
"""Folder of the held-out views."""
FOUND = "found from the dive"
"""In the first line of a calibration that nobody gave."""
ROW_TOLERANCE_S = 1e-3
"""``trajectory.tum`` and ``frames.csv`` may round a time differently; frames are further apart."""


class Dive:
    """What is in a dive folder; each file is read when it is first asked for, and then kept.

    The world is n (docs/conventions.md#world-n): ``frame.axes`` has its axes in words, and
    ``frame.unit`` its unit: metres, or the map unit, the median depth of the first keyframe.
    Sub-maps that are not both metric and level share neither origin nor unit unless they met.

    What is read may raise InputError, or ConfigError for a camera or settings: one sentence that
    names the file, what is wrong with it, and what to do.
    """

    def __init__(self, path: str | os.PathLike[str], **known: Any) -> None:
        """The dive in the folder ``path``; ``known``: attributes of a dive that is in memory,
        which are not read from it."""
        self.path = Path(path)
        unknown = [name for name in known if not isinstance(vars(Dive).get(name), cached_property)]
        assert not unknown, f"a Dive has no {unknown}"
        vars(self).update(known)
        self._maps: dict[int, Mapper] = {}
        self.white_balance: str | None = None
        """Of restored colours, where one was chosen anew (aquaflow/dive/white_balance.py)."""

    def __len__(self) -> int:
        """Number of frames, posed or not."""
        return len(self.frames)

    def __str__(self) -> str:
        """Its folder, for sentences."""
        return str(self.path)

    # --- the folder -----------------------------------------------------------------------------

    def file(self, name: str) -> Path:
        """A file of the folder, which may not be there; every reader of one comes through here."""
        return self.path / name

    def has(self, name: str) -> bool:
        """True if something has this name; what is no regular file is refused when it is read."""
        return os.path.lexists(self.file(name))

    def require(self, *names: str) -> None:
        """For whoever can do nothing without these files of a finished dive.

        Raises:
            InputError: the dive is not finished, or one of them is missing.
        """
        refuse_unfinished(self.path)
        for name in names:
            if not self.has(name):
                raise InputError(f"{self.path} holds no finished dive: {name} is missing")

    def facts(self, name: str) -> dict[str, Any]:
        """A JSON object of the dive, such as ``metrics.json``; empty where there is none.

        Raises:
            InputError: the file is damaged.
        """
        path = self.file(name)
        if not self.has(name):
            return {}
        try:
            found = read_regular_json(path)
            if not isinstance(found, dict):
                raise DamagedError("it is no JSON object")
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot read {path}: {reason_of(error)}; map the dive again"
            ) from error
        return found

    @property
    def recording(self) -> Path | None:
        """What was mapped, if it still lies where it did.

        Raises:
            InputError: metrics.json is damaged.
        """
        stated = self.facts(METRICS).get("recording")
        path = Path(stated) if isinstance(stated, str) and stated else None
        return path if path is not None and path.exists() else None

    @property
    def status(self) -> DiveStatus | None:
        """How the dive stands at the moment; None where nothing readable says so."""
        return read_status(self.path)

    @property
    def is_going_on(self) -> bool:
        """True if its files are those of a moment, written while the dive went on."""
        return self.metrics.get("complete") is False

    # --- what every dive has --------------------------------------------------------------------

    @cached_property
    def name(self) -> str:
        """Name of the dive, for people."""
        return printable(self.path.resolve().name)

    @cached_property
    def config(self) -> Config:
        """The settings that it was mapped with."""
        return load_config(self.file(CONFIG), inside=True)

    @cached_property
    def frames(self) -> Sequence[FrameRow]:
        """Every frame of the recording that was asked for, in the recording's order."""
        return read_rows(self.file(FRAMES))

    @cached_property
    def trajectory(self) -> Trajectory:
        """P poses, camera to world: positions in ``unit``, times in s since the first frame."""
        return read_tum(self.file(TRAJECTORY), inside=True)

    @cached_property
    def frame_of_pose(self) -> npt.NDArray[np.intp]:
        """[P] number of each pose's row in ``frames``."""
        return self.rows_of_poses(np.array([row.t_s for row in self.frames]))

    def rows_of_poses(
        self,
        times_s: npt.NDArray[np.float64],  # [F] s, of the rows of frames.csv
    ) -> npt.NDArray[np.intp]:
        """[P] the row of frames.csv that each pose belongs to, found by its time.

        Raises:
            InputError: a pose has no row.
        """
        order, poses = np.argsort(times_s, kind="stable"), self.trajectory
        found, rows = associate(poses.t_s, times_s[order], ROW_TOLERANCE_S)
        if len(found) < len(poses):
            raise InputError(
                f"{self.path}: {len(poses) - len(found)} of {len(poses)} poses in {TRAJECTORY} "
                f"have no row in {FRAMES}; both must come from the same run"
            )
        return order[rows]

    @property
    def sub_map_of_pose(self) -> npt.NDArray[np.intp]:
        """[P] number of the sub-map that each pose belongs to; -1 where the table has none."""
        numbers = [self.frames[row].sub_map for row in self.frame_of_pose]
        return np.array([-1 if number is None else number for number in numbers], np.intp)

    @cached_property
    def poses(self) -> Sequence[PoseRow]:
        """Each pose with what telemetry says of it: UTC, depth, attitude, place on the earth; not
        in dives of an older AquaFlow."""
        return read_trajectory_csv(self.file(TRAJECTORY_CSV))

    @cached_property
    def fixes(self) -> Sequence[FixRow]:
        """Every position fix that placed the dive, and its error; empty where none did."""
        return read_fixes_csv(self.file(FIXES)) if self.has(FIXES) else []

    def navigation(self) -> list[PoseRow]:
        """The rows of ``trajectory.csv``: UTC, depth, attitude and place on the earth of each pose.

        Raises:
            InputError: it is missing, as in dives of an older AquaFlow, or damaged.
        """
        return list(self.poses)

    @cached_property
    def camera(self) -> CameraModel:
        """The pinhole camera of the mapped pictures, pixels."""
        return load_camera(self.file(CAMERA), inside=True)

    @cached_property
    def calibration(self) -> CameraModel | None:
        """The camera that the pictures were undistorted with; None where they were not."""
        path = self.file(CALIBRATION)
        return load_camera(path, inside=True) if path.is_file() else None

    @cached_property
    def is_calibrated(self) -> bool:
        """True if the user gave the lens; False if the dive itself showed it."""
        try:
            with open_regular_text(self.file(CALIBRATION)) as stream:
                return FOUND not in stream.readline()
        except (OSError, ValueError):
            return False

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """``metrics.json``: counts, quality on held-out frames, times in ms, memory in MB; empty
        for a dive that was stopped before it was written."""
        return self.facts(METRICS)

    # --- its world ------------------------------------------------------------------------------

    @cached_property
    def metric_frames(self) -> Mapping[int, WorldFrame]:
        """The metric frame of each sub-map: what its world is, how well that is known, and from
        which telemetry; empty for a dive that was mapped by an older AquaFlow."""
        return read_metric_file(self.path)

    @cached_property
    def main(self) -> int:
        """The largest sub-map: that of ``map.aqf``."""
        return read_main(self.path)

    @property
    def frame(self) -> WorldFrame:
        """The metric frame of the largest sub-map."""
        return self.frame_of(self.main)

    def frame_of(self, sub_map: int) -> WorldFrame:
        """The metric frame of a sub-map; the unknown one where nothing is known of it."""
        return self.metric_frames.get(sub_map, WorldFrame.unknown())

    @property
    def unit(self) -> str:
        """Unit of lengths in the largest sub-map: ``m`` or ``map units``."""
        if self.metric_frames:
            return self.frame.unit
        return str(self.metrics.get("unit", WorldFrame.unknown().unit))

    # --- water, maps, pictures, places ----------------------------------------------------------

    @cached_property
    def medium_facts(self) -> dict[str, Any]:
        """``medium.json`` as it is; empty where there is none."""
        return self.facts(MEDIUM)

    @property
    def medium(self) -> Medium | None:
        """The water of the largest sub-map, with rates per ``unit``; None if none is modelled."""
        facts = self.medium_facts
        return medium_of(facts, self.file(MEDIUM)) if facts or self.has(MEDIUM) else None

    @cached_property
    def attenuations(self) -> Mapping[int, Sequence[float]]:
        """Attenuation of red, green and blue by sub-map, per map unit: of those whose water is
        known."""
        water, scale = self.medium, self.frame.T_nm.scale
        return {} if water is None else {self.main: [scale * rate for rate in water.beta_a]}

    @cached_property
    def maps(self) -> Mapping[int, Mapper]:
        """The maps by sub-map, of a dive that is in memory; of one in a folder ask :meth:`map`."""
        return {}

    def map(self, sub_map: int | None = None) -> Mapper:
        """The map of a sub-map, of the largest one if none is said, to be drawn by the renderer of
        the dive's settings; its views have no pictures.

        Raises:
            InputError: it is missing or damaged.
            ConfigError: the dive's settings cannot be read.
        """
        number = self.main if sub_map is None else sub_map
        if number in self.maps:
            return self.maps[number]
        if number not in self._maps:
            from aquaflow.dive.map_file import read_map_file  # loads torch
            from aquaflow.render import select_renderer

            renderer = select_renderer(self.config.mapping.renderer)
            self._maps[number] = read_map_file(self._map_file(number), renderer)
            self._maps[number].scene.finish()
        return self._maps[number]

    def _map_file(self, sub_map: int) -> Path:
        return self.file(map_name(sub_map, self.main))

    def views(self) -> Sequence[View]:
        """The views that the largest sub-map was made from, without pictures; of its Gaussians
        nothing is read.

        Raises:
            InputError: its map is missing or damaged.
        """
        if self.main in self.maps or self.main in self._maps:
            return self.map().views
        from aquaflow.dive.map_file import read_map_views  # loads torch

        return read_map_views(self._map_file(self.main))

    def filled_map(self) -> Mapper:
        """As :meth:`map`, of the largest sub-map.

        Raises:
            InputError: it is missing, damaged or empty.
            ConfigError: the dive's settings cannot be read.
        """
        mapper = self.map()
        if not mapper.views or len(mapper.gaussians) == 0:
            raise InputError(f"the map of {self.path} is empty; map a recording that shows more")
        return mapper

    @cached_property
    def held_out(self) -> Sequence[HeldOut | HeldOutFiles]:
        """The held-out views, in the order of the recording."""
        real = sorted((self.path / HELD_OUT).glob("*_real.png"))
        numbers = [path.name.removesuffix("_real.png") for path in real]
        return [HeldOutFiles(self, int(each)) for each in numbers if each.isdecimal()]

    @cached_property
    def places(self) -> PlacesFile:
        """The keyframes, to recognise places by."""
        return PlacesFile(self.file(PLACES))


@dataclass(frozen=True)
class HeldOutFiles:
    """A held-out view as its pictures are kept; the quality of a single one is not."""

    dive: Dive
    frame_index: int
    psnr: float | None = None
    ssim: float | None = None

    @property
    def real(self) -> npt.NDArray[np.uint8]:
        """[H, W, 3] RGB, as the camera saw it."""
        return self._read("real")

    @property
    def rendered(self) -> npt.NDArray[np.uint8]:
        """[H, W, 3] RGB, as the map shows it."""
        return self._read("rendered")

    @property
    def restored(self) -> npt.NDArray[np.uint8] | None:
        """[H, W, 3] RGB without its water, or [H, W, 4]; None where there is none."""
        return self._read_if_there("restored")

    @property
    def confidence(self) -> npt.NDArray[np.uint8] | None:
        """[H, W] 0 to 255, the share of ``restored`` that is the picture's."""
        return self._read_if_there("confidence")

    def _name(self, kind: str) -> str:
        return f"{HELD_OUT}/{self.frame_index:06d}_{kind}.png"

    def _read_if_there(self, kind: str) -> npt.NDArray[np.uint8] | None:
        return self._read(kind) if self.dive.has(self._name(kind)) else None

    def _read(self, kind: str) -> npt.NDArray[np.uint8]:
        """Raises InputError if the picture is missing or damaged."""
        path = self.dive.file(self._name(kind))
        try:
            return read_png(path, folders=1)
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot read {path}: {reason_of(error)}; map the dive again"
            ) from error


def read_dive(path: str | os.PathLike[str]) -> Dive:
    """Read the finished dive in the folder ``path``.

    Raises:
        InputError: the dive is not finished, or a file is missing or malformed, or does not match
            another.
        ConfigError: ``camera.yaml`` is malformed.
    """
    dive = Dive(path)
    dive.require()
    for attribute in ("frames", "frame_of_pose", "camera", "medium", "metrics", "metric_frames"):
        getattr(dive, attribute)
    return dive
