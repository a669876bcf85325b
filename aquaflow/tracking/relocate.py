"""Pose of a frame from its matches alone, where no prediction helps."""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.tracking.solver import PoseProblem

RANSAC_ITERATIONS = 200
RANSAC_PX = 3.0
MIN_INLIERS = 30


def pose_from_scratch(problem: PoseProblem) -> Sim3 | None:
    """T_fk by PnP in RANSAC; None without consensus."""
    import cv2

    if len(problem.points) < MIN_INLIERS:
        return None
    rays = problem.camera.unproject(problem.pixels)[:, :2]
    found, w, t, inliers = cv2.solvePnPRansac(
        problem.points,
        rays,
        np.eye(3),
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=RANSAC_PX / problem.camera.fx,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    pose = Sim3(
        so3_exp(np.asarray(w[:, 0], dtype=np.float64)), np.asarray(t[:, 0], dtype=np.float64)
    )
    return pose if pose.is_finite() else None
