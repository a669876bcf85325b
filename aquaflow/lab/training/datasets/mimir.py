"""MIMIR-UW (Alvarez-Tunon et al., IROS 2023): simulated surveys in the EuRoC layout.

``SeaFloor/[auv0/]track0/{rgb,depth}/cam0/{data/<ns>.png|.exr, data.csv, sensor.yaml}`` and
``track0/pose_groundtruth/data.csv``: ``ns, x, y, z, qw, qx, qy, qz, ...`` of the body. A sensor's
axes are x forward, y right, z down; depth is z.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.lab.training.datasets.posed import (
    NED_TO_OPTICAL,
    Array,
    Frames,
    Posed,
    nothing_in,
    pose,
    read_image,
    table,
)
from aquaflow.lab.training.datasets.tartanair import read_exr

APART_NS = 20_000_000
"""A picture has the pose of this moment at most before or after it: poses come at 30 to 210 Hz."""


def mimir(root: Path) -> list[Frames]:
    """One sequence for each camera of each track under ``root``.

    Raises:
        InputError: there is none, or a calibration or table cannot be read.
    """
    cameras = [path.parent for path in sorted(root.rglob("rgb/cam*/sensor.yaml"))]
    if not cameras:
        raise nothing_in(root, "MIMIR-UW track (rgb/cam0/sensor.yaml)")
    return [_camera(folder, root) for folder in cameras]


def _camera(folder: Path, root: Path) -> Frames:
    track, name = folder.parents[1], folder.name
    K, T_bc = _calibration(folder / "sensor.yaml")
    rows = table(track / "pose_groundtruth" / "data.csv", 8, ",")
    moments = rows[:, 0].astype(np.int64)
    readers = []
    for image in sorted((folder / "data").glob("*.png")):
        depth = track / "depth" / name / "data" / f"{image.stem}.exr"
        nearest = int(np.argmin(np.abs(moments - _moment(image))))
        if not depth.is_file() or abs(moments[nearest] - _moment(image)) > APART_NS:
            continue
        T_wb = pose(rows[nearest, 1:4], rows[nearest, 4:8])
        readers.append(partial(_frame, image, depth, K, T_wb @ T_bc))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(
    image: Path,
    depth: Path,
    K: Array,  # [3, 3] px
    T_wc: Array,  # [4, 4] m
) -> Posed:
    return Posed(read_image(image), read_exr(depth), K, T_wc)


def _moment(image: Path) -> int:
    try:
        return int(image.stem)
    except ValueError as error:
        raise InputError(f"{image} is not named after its time in ns; unpack it again") from error


def _calibration(path: Path) -> tuple[Array, Array]:
    """K and T_bc of the camera's optical axes."""
    try:
        sensor = read_mapping(path, "calibration", "unpack it again")
        K = np.array(sensor["intrinsics"], dtype=np.float64).reshape(3, 3)
        T_bs = np.array(sensor["T_BS"], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no calibration of a camera; unpack it again") from error
    return K, T_bs @ NED_TO_OPTICAL
