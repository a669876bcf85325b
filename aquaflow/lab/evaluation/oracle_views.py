"""True ranges of pictures, for an oracle: of a synthetic dive, or of one that was mapped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import SourceConfig
from aquaflow.dive.dive import MAP, Dive
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.dive_files import evaluated_dive
from aquaflow.prior.oracle import TrueView, write_oracle
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int, int | None], None]

NO_PIXELS = np.zeros((0, 0, 3), np.uint8)
"""Of a view that is only drawn."""
COVERED = 0.5
"""Alpha of a map from which its range is one."""


def make_oracle(
    recording: Path,
    out: Path,
    range_sigma: float,
    progress: Progress,
    dive: Path | None = None,
    dense: bool = False,
) -> int:
    """Write an oracle of the pictures of ``recording``: a synthetic dive, or one that ``dive``
    mapped; ``dense``: of all their pixels. Returns how many pictures it knows.

    Raises:
        InputError: there is no truth, or it does not fit the recording.
    """
    found = []
    for view in _synthetic(recording) if dive is None else _mapped_frames(recording, dive):
        found.append(view)
        progress("views", len(found), None)
    if not found:
        raise InputError(f"{recording} has no picture with a true range; give a dive that has them")
    write_oracle(out, [view for view, _ in found], found[0][1], range_sigma, dense=dense)
    return len(found)


def _synthetic(recording: Path) -> Iterator[tuple[TrueView, CameraModel]]:
    from aquaflow.lab.synthetic.truth import read_truth

    truth = read_truth(recording)
    for frame in _prepare(recording, SourceConfig(), truth.camera):
        T = truth.T_wc[frame.index]
        yield _view(frame, truth.range_m(frame.index), Sim3(T[:3, :3], T[:3, 3]))


def _mapped_frames(recording: Path, dive: Path) -> Iterator[tuple[TrueView, CameraModel]]:
    """The frames that the map's own sub-map placed, with the ranges that the map shows."""
    from aquaflow.dive.map_file import read_map_file  # torch, which no other kind needs
    from aquaflow.render import select_renderer
    from aquaflow.render.transfers import picture_out
    from aquaflow.render.views import View

    read = Dive(dive)
    T_nm = read.frame.T_nm
    mapper = read_map_file(read.file(MAP), select_renderer("auto", None))
    found = evaluated_dive(read).trajectory
    placed = zip(found.R_wc, found.positions, strict=True)
    poses = dict(zip(np.round(1e6 * found.t_s), placed, strict=True))
    for frame in _prepare(recording, read.config.source, read.calibration):
        pose = poses.get(round(1e-3 * frame.t_ns))
        if pose is None:
            continue
        T_mc = T_nm.inverse() @ Sim3(*pose)
        seen = mapper.show(View(0, NO_PIXELS, frame.camera, T_mc, keyframe=0, robust=False))
        ranges = np.where(picture_out(seen.alpha) > COVERED, picture_out(seen.z), np.inf)
        yield _view(frame, ranges, T_mc)


def _prepare(recording: Path, source: SourceConfig, camera: CameraModel | None) -> Iterator[Frame]:
    reader = open_recording(recording, fps=source.fps)
    prepare = Preparation(source, camera or reader.camera)
    try:
        for frame in reader.frames(source.every, source.start, source.stop):
            if isinstance(frame, Frame):
                yield prepare(frame)
    finally:
        reader.close()


def _view(
    frame: Frame,
    ranges: npt.NDArray[np.floating],  # [h, w] of the same rays; inf where nothing is hit
    T_wc: Sim3,
) -> tuple[TrueView, CameraModel]:
    camera = frame.camera
    size = (camera.width, camera.height)
    at = cv2.resize(ranges.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    known = np.isfinite(at) & (at > 0.0)
    distance = np.asarray(np.where(known, at, np.nan), dtype=np.float64)
    rays = camera.unproject(camera.pixel_centres())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points = T_wc.apply(rays * distance[..., None])
    return TrueView(frame.image, points, distance, T_wc), camera
