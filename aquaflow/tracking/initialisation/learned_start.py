"""The first map from one pair of pictures, by what a prior knows of their ranges (paper, Sec. 3.2).

Two pictures with hardly any parallax have no geometry of their own. Where the prior's ranges are
certain enough, and both pictures' agree, they are the first map; triangulation corrects it once the
camera has moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import PairGeometry
from aquaflow.tracking.learned.scaling import LearnedDepth, agreement, unscaled_depth
from aquaflow.tracking.pose.problem import pose_problem
from aquaflow.tracking.pose.solver import PoseEstimate, solve_pose

MATCHES = 2000
"""Of the pair, that its pose is solved from."""


@dataclass(frozen=True)
class LearnedStart:
    """The reference's pointmap, its median depth 1, and the second picture's pose."""

    pointmap: Pointmap
    T_fk: Sim3
    """Reference to second picture."""


def learned_start(
    pair: PairGeometry, camera: CameraModel, config: TrackingConfig
) -> LearnedStart | None:
    """A map from ``pair``; None where the prior knows no ranges, or only up to a shift, states that
    they are less certain than ``learned.start_sigma``, or contradicts itself or the matches."""
    if not (config.learned.start and camera.calibrated) or pair.range_unit == "affine":
        return None
    if pair.X_a is None or pair.Q_a is None or pair.X_b is None or pair.Q_b is None:
        return None
    depth_a = unscaled_depth(camera, pair.X_a, pair.Q_a)
    depth_b = unscaled_depth(camera, pair.X_b, pair.Q_b)
    if depth_a is None or depth_b is None or _sigma(depth_a) > config.learned.start_sigma:
        return None
    estimate, honesty = _posed(pair, camera, depth_a, depth_b, config)
    if estimate is None or estimate.inlier_share < config.initialisation.min_explained:
        return None
    honest = unscaled_depth(camera, pair.X_a, pair.Q_a, max(honesty, 1.0))
    if honest is None or _sigma(honest) > config.learned.start_sigma:
        return None
    return LearnedStart(replace(Pointmap.unknown(camera), learned=honest.kept), estimate.T)


def _sigma(depth: LearnedDepth) -> float:
    """Median relative sigma."""
    return float(np.sqrt(np.median(depth.variance[depth.known])))


def _posed(
    pair: PairGeometry,
    camera: CameraModel,
    depth_a: LearnedDepth,
    depth_b: LearnedDepth,
    config: TrackingConfig,
) -> tuple[PoseEstimate | None, float]:
    """The second picture's pose, and by how much both pictures' ranges differ, in stated errors."""
    rows, columns = np.nonzero(pair.valid & depth_a.known)
    if len(rows) < config.min_matches:
        return None, 1.0
    step = -(-len(rows) // MATCHES)
    rows, columns = rows[::step], columns[::step]
    pointmap = replace(Pointmap.unknown(camera), learned=depth_a.kept).completed(1.0)
    pixels_a = np.stack([columns + 0.5, rows + 0.5], -1)
    pixels_b = pair.matches[rows, columns].astype(np.float64)
    weights = pair.C[rows, columns].astype(np.float64)
    problem = pose_problem(pointmap, pixels_a, pixels_b, camera, config.sigma_px, weights)
    estimate = solve_pose(problem, Sim3.identity())
    if estimate is None:
        return None, 1.0
    z_in_b = estimate.T.apply(problem.points)[:, 2]
    return estimate, agreement(depth_a, depth_b, z_in_b, pixels_a, pixels_b)
