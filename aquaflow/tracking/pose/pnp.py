"""Pose of a frame from its matches alone, where no prediction helps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.tracking.pose.solver import PoseProblem

RANSAC_ITERATIONS = 200
"""Most samples that are tried."""
RANSAC_PX = 3.0
"""Reprojection error up to which a match agrees with a pose."""
MIN_INLIERS = 30
"""Matches that must agree on a pose."""
LEAST_WIDTH = 1e-3
"""Of a set of points over its length; thinner is a line, to the depths' own precision."""


def pose_from_scratch(problem: PoseProblem, least: int = MIN_INLIERS) -> Sim3 | None:
    """T_fk by PnP in RANSAC; None without a consensus of ``least`` matches.

    SQPnP raises on one degenerate sample (points on a line, or at one place), and with it ends the
    whole search: there P3P, which skips such samples, searches again.
    """
    import cv2

    if len(problem.points) < least:
        return None
    try:
        pose = _consensus(problem, cv2.SOLVEPNP_SQPNP, least)
    except cv2.error:
        line = not _is_no_line(problem.points)
        pose = None if line else _consensus(problem, cv2.SOLVEPNP_AP3P, least)
    return pose if pose is not None and pose.is_finite() else None


def _is_no_line(
    points: npt.NDArray[np.float64],  # [N, 3]
) -> bool:
    """True if the points span a plane; around a line the camera could be anywhere."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > LEAST_WIDTH * spread[0])


def _consensus(problem: PoseProblem, solver: int, least: int) -> Sim3 | None:
    import cv2

    rays = problem.camera.unproject(problem.pixels)[:, :2]
    found, w, t, inliers = cv2.solvePnPRansac(
        problem.points,
        rays,
        np.eye(3),
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=RANSAC_PX / problem.camera.fx,
        flags=solver,
    )
    if not found or inliers is None or len(inliers) < least:
        return None
    rotation, translation = (np.asarray(each[:, 0], dtype=np.float64) for each in (w, t))
    return Sim3(so3_exp(rotation), translation)
