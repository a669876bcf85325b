"""Where a keyframe's pixels are expected in the next frame, if its motion is known beforehand."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap

WIDE_WIDTHS = 0.04
"""Widths of the picture: flow follows smaller steps from the last matches as well, and DIS alone
loses those beyond 0.15 (``prior/flow_pair.py``)."""
GRID = 12
"""Pixels a side that are looked at to tell whether a step is wide."""


def is_wide(pointmap: Pointmap, T_before: Sim3, T_next: Sim3, camera: CameraModel) -> bool:
    """True if the pictures' shift from one pose of the frame to the other is wide."""
    height, width = pointmap.rho.shape
    points = _points(pointmap, max(1, height // GRID), max(1, width // GRID)).reshape(-1, 3)
    before, after = T_before.apply(points), T_next.apply(points)
    ahead = (before[:, 2] > 0.0) & (after[:, 2] > 0.0)
    if not ahead.any():
        return False
    shift = camera.project(after[ahead]) - camera.project(before[ahead])
    return bool(np.median(np.linalg.norm(shift, axis=1)) > WIDE_WIDTHS * camera.width)


def expected_matches(
    pointmap: Pointmap,
    T_fk: Sim3,
    camera: CameraModel,
) -> npt.NDArray[np.float32]:
    """[H, W, 2] px where the pose puts the keyframe's pixels; those of unknown depth are taken to
    be at the median of the others."""
    points = T_fk.apply(_points(pointmap))
    points[..., 2] = np.maximum(points[..., 2], 1e-3)
    return camera.project(points).astype(np.float32)


def _points(pointmap: Pointmap, down: int = 1, across: int = 1) -> npt.NDArray[np.float64]:
    """[H / down, W / across, 3] in the camera frame of the keyframe."""
    rho = pointmap.rho[::down, ::across]
    known = rho > 1e-6
    usual = float(np.median(rho[known])) if known.any() else 1.0
    height, width = pointmap.rho.shape
    u, v = np.meshgrid(np.arange(0, width, across) + 0.5, np.arange(0, height, down) + 0.5)
    rays = pointmap.camera.unproject(np.stack([u, v], axis=-1))
    return np.asarray(rays / np.where(known, rho, usual)[..., None])
