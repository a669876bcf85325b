"""The dive folder: what a run writes, during it and at its end (docs/formats.md#dive-folder)."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import refuse_linked_folders
from aquaflow.base.storage.atomic import (
    atomic_write,
    is_part,
    make_subfolder,
    open_to_append,
    write_json,
    write_yaml,
)
from aquaflow.base.storage.dive_status import (
    CHECKPOINT,
    DiveState,
    DiveStatus,
    is_cut_off_replay,
)
from aquaflow.base.storage.dive_status import NAME as STATUS
from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.config import Config
from aquaflow.dive.dive import CALIBRATION, FRAMES
from aquaflow.dive.fixes_csv import NAME as FIXES
from aquaflow.dive.fixes_csv import FixRow, write_fixes_csv
from aquaflow.dive.frames_csv import FrameRow, header, of_text, to_text
from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.log import JsonLog
from aquaflow.dive.png import write_png
from aquaflow.dive.results import WaterSummary
from aquaflow.dive.trajectory_csv import NAME as PATH_TABLE
from aquaflow.dive.trajectory_csv import PoseRow, write_trajectory_csv
from aquaflow.dive.tum import write_tum
from aquaflow.geometry.camera import CameraModel, save_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY
from aquaflow.telemetry.known_lengths.known_length import FILE as KNOWN_LENGTHS
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper

log = logging.getLogger(__name__)

MARKER = FRAMES
"""The file by which a folder is known to be a dive."""

TRACE = "trace.json"
"""Every run of every stage, in Chrome's trace event format; written when asked for."""

SUGGESTED = "found_camera.yaml"
"""Calibration that a dive without one found too late to use it."""

IN_SITE = "in_site.json"
"""Where a dive lies in an earlier one that it was looked for in."""

DELIVERABLES = (
    *("trajectory.tum", "camera.yaml", "map*.ply", "map*.aqf", "medium.json", SUGGESTED, IN_SITE),
    *("metrics.json", "report.html", "heldout/*.png", "heldout/*.npz", TRACE),
    *("coverage.npz", "coverage.json", "coverage.png", "overview.png"),
    *("metric.json", "trajectory.csv", FIXES, "georeference.json", "places.npz"),
    *("reef_numbers.csv", "reef_numbers.json"),
)
"""What is written at the end of a run, and of a live dive partly while it goes on."""
EARLIER = ".earlier"
"""Before the suffix of a deliverable that was not written again at the dive's end."""

RESULTS = (
    *DELIVERABLES,
    f"*{EARLIER}.*",
    *(CALIBRATION, KNOWN_LENGTHS, TELEMETRY),
    *("pictures/*.jpg", "view.zip", "report.pdf"),
    *("restored/*.png", "points.laz", "points.e57", "map.spz"),
    *("colmap/images/*.png", "colmap/sparse/0/*.bin"),
    *("nerfstudio/images/*.png", "nerfstudio/points.ply", "nerfstudio/transforms.json"),
    *("mesh.ply", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.glb", "ortho/*.tif", "dem/*.tif"),
    *("dive.mcap", "dive.layout.json"),
)
"""What a run writes, and what is made of it; of an earlier run in the same folder nothing must
remain."""

WORK = "work"
"""Folder of data that does not fit into memory; removed at the end of the run."""


class DiveFolder:
    """Writes one dive; finished frames are on disk at once, final files are atomic."""

    def __init__(
        self,
        path: Path,
        config: Config,
        overwrite: bool = False,
        resume: Iterable[FrameRow] | None = None,
        dive_s: Callable[[], float | None] = lambda: None,
    ) -> None:
        """Make the folder; or ``resume`` the dive in it, which has these rows so far. No other
        process gets it until :meth:`close`. ``dive_s``: seconds since the first frame of a live
        dive, for its log; None before it.

        Raises:
            InputError: it cannot be made, another process writes to it, it holds something else,
                or it holds a dive and neither ``overwrite`` nor ``resume`` is set.
        """
        self.path = path
        self._recorded = bytearray()
        """The rows so far as lines of frames.csv: a tenth of what they take as objects."""
        self._lock = self._make()
        try:
            self._open(config, overwrite, resume, dive_s)
        except BaseException:
            self._lock.release()
            raise

    def _open(
        self,
        config: Config,
        overwrite: bool,
        resume: Iterable[FrameRow] | None,
        dive_s: Callable[[], float | None],
    ) -> None:
        path = self.path
        try:
            refuse_linked_folders(path)
        except OSError as error:
            raise InputError(
                f"cannot write to {error.filename}: {error.strerror}; remove it"
            ) from error
        if resume is None:
            self._claim(overwrite)
        else:
            self._add(resume)
        write_yaml(path / "config.yaml", config.model_dump(mode="json"))
        self._rewrite_frames(self._recorded)
        self._frames = open_to_append(path / MARKER)
        self._log = JsonLog(path / "log.jsonl", append=resume is not None, dive_s=dive_s)
        self._log.attach()

    def _make(self) -> FolderLock:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unmade(self.path, error) from error
        return FolderLock(self.path)

    def _claim(self, overwrite: bool) -> None:
        try:
            occupied = any(not is_part(each) for each in self.path.iterdir())
        except OSError as error:
            raise _unmade(self.path, error) from error
        if occupied and not any((self.path / name).exists() for name in (MARKER, STATUS)):
            raise InputError(
                f"{self.path} holds files that are not a dive; choose an empty folder as --out"
            )
        if occupied and not overwrite and not is_cut_off_replay(self.path):
            raise InputError(
                f"{self.path} already holds a dive; choose another --out or add --overwrite"
            )
        # Before anything of an earlier dive goes, and before any file of this one.
        DiveStatus(DiveState.OPEN).write(self.path)
        for pattern in RESULTS:
            for old in self.path.glob(pattern):
                old.unlink()
        for folder in (WORK, CHECKPOINT):  # of a run that was stopped
            shutil.rmtree(self.path / folder, ignore_errors=True)

    @property
    def work(self) -> Path:
        """Folder for data that does not fit into memory."""
        return self.path / WORK

    def close(self, keep_work: bool = False) -> None:
        """Release the open files; what was written stays, with ``keep_work`` for a resumption."""
        if not keep_work:
            shutil.rmtree(self.work, ignore_errors=True)
        self._log.close()
        self._close_frames()
        self._lock.release()

    @property
    def rows(self) -> Sequence[FrameRow]:
        """The rows recorded so far."""
        return of_text(self._recorded.decode("utf-8"))

    # --- while the dive runs ------------------------------------------------------------------

    def record(self, rows: Iterable[FrameRow]) -> None:
        """Append finished frames, in completion order."""
        lines = self._add(rows)
        try:
            self._frames.write(lines)
            self._frames.flush()
        except OSError as error:  # a full disk ends no dive; all rows are written at its end
            log.warning("frames.csv takes no more for now: %s", error.strerror)

    def _add(self, rows: Iterable[FrameRow]) -> bytes:
        lines = to_text(rows).encode("utf-8")
        self._recorded += lines
        return lines

    def set_finished(self) -> None:
        """Nothing comes any more, and every file is there that there will be.

        Raises:
            InputError: dive.json cannot be written.
        """
        DiveStatus(DiveState.FINISHED).write(self.path)

    # --- at its end ---------------------------------------------------------------------------

    def deliverables(self) -> dict[Path, int]:
        """Those that are there, and the inode of each: a file that is written has another one."""
        found = (path for pattern in DELIVERABLES for path in self.path.glob(pattern))
        return {path: path.stat().st_ino for path in found if EARLIER not in path.suffixes}

    def set_aside(self, before: Mapping[Path, int]) -> None:
        """Rename deliverables that were there ``before`` and were not written since, ``map.ply`` to
        ``map.earlier.ply``: they are of another moment than the rest. Those of which the rest has
        a newer one are removed."""
        now = self.deliverables()
        for path, inode in before.items():
            if now.get(path) == inode:
                path.replace(path.with_suffix(EARLIER + path.suffix))
                log.warning("%s was not written again: it is of an earlier moment", path.name)
        for old in [*self.path.glob(f"*{EARLIER}.*"), *self.path.glob(f"heldout/*{EARLIER}.*")]:
            if old.with_name(old.name.replace(EARLIER, "")).exists():
                old.unlink()

    def write_frames(self, sub_maps: Mapping[int, int]) -> None:
        """frames.csv once more: in the order of the recording, each posed frame in the sub-map that
        it ended up in (``sub_maps`` by frame index)."""
        rows = [replace(row, sub_map=sub_maps.get(row.index, row.sub_map)) for row in self.rows]
        self._close_frames()
        self._rewrite_frames(to_text(sorted(rows, key=lambda row: row.index)).encode("utf-8"))

    def _close_frames(self) -> None:
        with contextlib.suppress(OSError):  # rows that a full disk did not take; nothing is lost
            self._frames.close()

    def _rewrite_frames(self, lines: bytes | bytearray) -> None:
        with atomic_write(self.path / MARKER) as stream:
            stream.write(header().encode("utf-8"))
            stream.write(lines)

    def write_trajectory(self, t_s: list[float], poses: list[Sim3], comment: str = "") -> None:
        """trajectory.tum: every frame that has a pose; ``comment``: what the world is."""
        order = np.argsort(t_s, kind="stable")
        self.write_poses(
            np.array([t_s[i] for i in order]),
            np.array([poses[i].t for i in order]).reshape(-1, 3),
            np.array([poses[i].quaternion for i in order]).reshape(-1, 4),
            comment,
        )

    def write_poses(
        self,
        t_s: npt.NDArray[np.float64],  # [N] s, increasing
        positions: npt.NDArray[np.float64],  # [N, 3] n
        wxyz: npt.NDArray[np.float64],  # [N, 4] n from camera
        comment: str = "",
    ) -> None:
        """trajectory.tum of poses in their order."""
        write_tum(self.path / "trajectory.tum", t_s, positions, wxyz, comment=comment)

    def write_path_table(self, rows: Sequence[PoseRow]) -> None:
        """trajectory.csv."""
        write_trajectory_csv(self.path / PATH_TABLE, rows)

    def write_fixes(self, rows: Sequence[FixRow]) -> None:
        """fixes.csv."""
        write_fixes_csv(self.path / FIXES, rows)

    def write_metric_frames(self, frames: Mapping[int, WorldFrame], main: int) -> None:
        """metric.json; ``main`` is the largest sub-map."""
        write_metric_file(self.path, frames, main)

    def write_calibration(self, calibration: CameraModel | None) -> None:
        """calibration.yaml, at the begin of a live dive, which may have no end; None: none."""
        if calibration is not None:
            save_camera(calibration, self.path / CALIBRATION)

    def write_cameras(
        self, mapped: CameraModel, calibration: CameraModel | None, comment: str = ""
    ) -> None:
        """camera.yaml: the pinhole camera of the mapped pictures; calibration.yaml: the one that
        they were undistorted with, where there is one, with a ``comment`` on where it is from."""
        save_camera(mapped, self.path / "camera.yaml")
        if calibration is not None:
            save_camera(calibration, self.path / CALIBRATION, comment)

    def write_suggested_camera(self, camera: CameraModel, comment: str) -> None:
        """found_camera.yaml: a calibration for the next dive."""
        save_camera(camera, self.path / SUGGESTED, comment)

    def write_map(self, mapper: Mapper, suffix: str = "") -> None:
        """map.aqf: the exact map."""
        from aquaflow.dive.map_file import write_exact  # loads torch

        write_exact(self.path, mapper, suffix)

    def write_splats(
        self, mapper: Mapper, water: WaterSummary | None, frame: WorldFrame, suffix: str = ""
    ) -> None:
        """map.ply as seen through water at the median range, map_clear.ply without water, both in
        ``frame``; where there is a decoder, each Gaussian as the mapped view nearest to it sees it.

        ``water``: in map units.
        """
        from aquaflow.dive.map_file import write_splats  # loads torch

        write_splats(self.path, mapper, water, frame, suffix)

    def write_medium(self, content: dict[str, Any]) -> None:
        """medium.json: the water, see :func:`aquaflow.dive.results.medium_json`."""
        self.write_json("medium.json", content)

    def write_held_out(self, examples: list[HeldOut]) -> None:
        """heldout/: what the camera saw, also without its water and how much of that is restored,
        what the map shows, its range."""
        folder = self.path / "heldout"
        make_subfolder(folder)
        for example in examples:
            if example.z is not None:
                with atomic_write(folder / f"{example.frame_index:06d}_range.npz") as stream:
                    np.savez_compressed(stream, z=example.z)
            pictures = {"real": example.real, "rendered": example.rendered}
            if example.restored is not None:
                pictures["restored"] = example.restored
            if example.confidence is not None:
                pictures["confidence"] = example.confidence
            for name, picture in pictures.items():
                write_png(folder / f"{example.frame_index:06d}_{name}.png", picture)

    def write_json(self, name: str, data: dict[str, Any]) -> None:
        """A JSON file of the dive; a number that is not finite is unknown, null."""
        write_json(self.path / name, _finite(data))


def _unmade(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot make the dive folder {path}: {error.strerror}; choose another --out")


def _finite(value: Any) -> Any:
    """``value`` for JSON, with None for every number in it that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    return [_finite(each) for each in value] if isinstance(value, (list, tuple)) else value
