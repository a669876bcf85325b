"""What is read of a row, and its poses, against the same pictures read plainly."""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.api.recording import map_recording
from aquaflow.base.errors import AquaFlowError
from aquaflow.dive import run
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.sources import open_recording
from aquaflow.sources.telemetry_input import open_telemetry
from aquaflow.types import Depth, Frame, Position, UtcTime
from tests.recordings.inputs import ROWS, Dive, Made, Row, write_plainly

LEAST_ERROR = 0.0002
"""Of the path: what less is makes no ratio."""
SAME_TIME_S = 1.5e-3
"""Containers count milliseconds."""
SETTINGS: dict[str, Any] = {
    "threads": 1, "mapping": {"enabled": False}, "pictures": {"enabled": False},
}  # fmt: skip


@dataclass(frozen=True)
class Figures:
    """Of one row: frames with a pose, of the plain reading too; the difference of the worst
    picture; the largest angle between poses; and the error over that of the plain reading."""

    frames: int
    wanted: int
    grey_levels: float
    rotation_deg: float
    ratio: float

    def line(self, name: str) -> str:
        """Of the table."""
        return (
            f"| {name} | {self.frames} of {self.wanted} | {self.grey_levels:.1f} | "
            f"{self.rotation_deg:.2f} | {self.ratio:.2f} "
        )


@dataclass(frozen=True)
class Poses:
    """Of one dive: rotations about the truth's axes, and the error over the path."""

    R_wc: np.ndarray[Any, Any]  # [N, 3, 3] camera to the truth's world
    error: float


def all_rows() -> list[Row]:
    """Of every file of the table."""
    for kind in ("films", "folders", "bags", "calibrations", "logs"):
        import_module(f"tests.recordings.inputs.{kind}")
    return ROWS


class Judge:
    """Reads and maps rows; the plain readings that they share are mapped once."""

    def __init__(self, dive: Dive, folder: Path) -> None:
        self._dive, self._folder = dive, folder
        self._plain: dict[bytes, Poses] = {}

    def made(self, row: Row, folder: Path) -> Made:
        """The row's recording, in ``folder``; its test is skipped without the program it needs."""
        if row.needs and shutil.which(row.needs) is None:
            pytest.skip(f"the program {row.needs} is not installed")
        return row.make(self._dive, folder)

    def refusal(self, row: Row, folder: Path) -> str:
        """Words of what mapping ends in; asserts that they name the row's cause."""
        with pytest.raises(AquaFlowError, match=row.refuses) as refused:
            self._map(self.made(row, folder), folder / "dive")
        return str(refused.value)

    def figures(self, made: Made, folder: Path, grey_levels: float = 0.0) -> Figures:
        """Map a recording and the plain reading of its pictures, and compare poses."""
        poses, plain = self._poses(self._map(made, folder / "dive"), made), self._of_plain(made)
        if len(poses.R_wc) != len(plain.R_wc):
            return Figures(len(poses.R_wc), len(plain.R_wc), grey_levels, math.inf, math.inf)
        turned = poses.R_wc.swapaxes(1, 2) @ plain.R_wc
        cosine = np.clip((np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
        ratio = max(poses.error, LEAST_ERROR) / max(plain.error, LEAST_ERROR)
        rotation = float(np.degrees(np.arccos(cosine)).max())
        return Figures(len(poses.R_wc), len(plain.R_wc), grey_levels, rotation, ratio)

    def read(self, row: Row, made: Made) -> float:
        """Compare what is read with what was written; the mean difference of the worst picture."""
        recording = open_recording(made.source, made.fps, made.topic)
        read = list(recording.frames())
        recording.close()
        assert len(read) == len(made.pictures), recording.notes
        worst = 0.0
        for index, (frame, picture) in enumerate(zip(read, made.pictures, strict=True)):
            assert isinstance(frame, Frame) == (picture is not None), frame
            assert abs(frame.t_ns * 1e-9 - made.times_s[index]) < SAME_TIME_S, frame.t_ns
            if isinstance(frame, Frame) and picture is not None:
                assert frame.image.shape == picture.shape
                apart = np.abs(frame.image.astype(np.int16) - picture).mean()
                worst = max(worst, float(apart))
        assert worst <= row.near, f"{worst:.2f} grey levels"
        assert row.says in "; ".join(recording.notes), recording.notes
        if made.camera is None or made.calibration is not None:
            assert recording.camera is None
        if made.camera is not None:
            given = None if made.calibration is None else load_camera(made.calibration)
            _assert_same_camera(given or recording.camera, made.camera)
        if made.log is not None:
            _assert_same_telemetry(made, made.log)
        return worst

    def _map(self, made: Made, out: Path) -> Path:
        calibration: Any = made.calibration
        if calibration is None and made.camera is None:
            calibration = self._dive.camera
        settings = SETTINGS | {"source": {} if made.fps is None else {"fps": made.fps}}
        logs = [] if made.log in (None, made.source) else [made.log]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(run, "deliverables_of", lambda slam: {})  # report and coverage
            map_recording(
                made.source, out, calibration=calibration, settings=settings, topic=made.topic,
                telemetry=logs, telemetry_offset_s=0.0 if logs else None,
            )  # fmt: skip
        return out

    def _of_plain(self, made: Made) -> Poses:
        camera = made.camera or self._dive.camera
        pictures = made.plain or made.pictures
        key = repr((camera, made.times_s)).encode() + b"".join(
            b"-" if picture is None else picture.tobytes() for picture in pictures
        )
        if key not in self._plain:
            folder = self._folder / str(len(self._plain))
            plain = write_plainly(folder, replace(made, pictures=pictures), camera)
            read = Made(plain, made.pictures, made.times_s, camera)
            self._plain[key] = self._poses(self._map(read, folder / "dive"), made)
        return self._plain[key]

    def _poses(self, dive: Path, made: Made) -> Poses:
        truth, found = read_tum(self._dive.truth), read_tum(dive / "trajectory.tum")
        rows = [int(np.argmin(np.abs(np.array(made.times_s) - t))) for t in found.t_s]
        target = truth.positions[np.array(rows) * made.every]
        aligned = align(found.positions, target, with_scale=True).T_target_source
        length = np.linalg.norm(np.diff(target, axis=0), axis=1).sum()
        apart = aligned.apply(found.positions) - target
        return Poses(aligned.R @ found.R_wc, float(np.sqrt((apart**2).sum(axis=1).mean()) / length))


def _assert_same_telemetry(made: Made, path: Path) -> None:
    log = open_telemetry(path, fps=made.fps, topic=made.topic).synchronised[0]
    samples = list(log.samples())
    log.close()
    depths = [(each.t_ns * 1e-9, each.depth_m) for each in samples if isinstance(each, Depth)]
    assert depths == [pytest.approx(each, abs=1e-6) for each in made.samples]
    said = [(each.t_ns * 1e-9, each.utc_ns * 1e-9) for each in samples if isinstance(each, UtcTime)]
    fixes = [
        (each.t_ns * 1e-9, each.latitude_deg, each.longitude_deg, each.sigma_m)
        for each in samples
        if isinstance(each, Position)
    ]
    assert fixes == [pytest.approx(each, abs=1e-9) for each in made.fixes]
    if made.utc:
        assert said == [pytest.approx(each, abs=1e-6) for each in made.utc]
    assert made.log_says in "; ".join(log.notes), log.notes


def _assert_same_camera(found: CameraModel | None, wanted: CameraModel) -> None:
    assert found is not None
    assert (found.width, found.height) == (wanted.width, wanted.height)
    assert found.is_distorted == wanted.is_distorted
    if wanted.is_distorted:
        assert found.distortion_model == wanted.distortion_model
    d = max(len(found.distortion), len(wanted.distortion))
    lens = [
        (each.fx, each.fy, each.cx, each.cy, *each.distortion, *[0.0] * (d - len(each.distortion)))
        for each in (found, wanted)
    ]
    assert lens[0] == pytest.approx(lens[1], rel=1e-6, abs=1e-9)
