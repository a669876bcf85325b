"""Matches with a keyframe's pointmap as the problem that the pose solver solves."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.pose.solver import PoseProblem

Array = npt.NDArray[np.float64]


def pose_problem(
    pointmap: Pointmap,
    pixels_k: Array,  # [M, 2] px, in the keyframe, where its depth is known
    pixels: Array,  # [M, 2] px, in the frame
    camera: CameraModel,
    sigma_px: float,
    weights: Array | None = None,  # [M]; None: all 1
) -> PoseProblem:
    """Matches of a frame seen by ``camera`` with the points of a keyframe's ``pointmap``."""
    rho = at_pixels(pointmap.rho, pixels_k)
    return PoseProblem(
        pointmap.camera.unproject(pixels_k) / rho[:, None],
        at_pixels(pointmap.variance, pixels_k),
        pixels,
        np.ones(len(pixels)) if weights is None else weights,
        camera,
        sigma_px,
    )
