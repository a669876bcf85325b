"""Is this the same place? A pose from keypoints alone, and whether chance could have made it.

Dense flow finds a tenth of a picture in any other picture, and nothing in the same one turned
round. Keypoints do neither: between pictures of different places some ten descriptors agree, and
their pixels agree on no pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import VerificationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.keyframes.place import KeypointDepths, depths_at
from aquaflow.prior.contract import Encoding, Keypoints
from aquaflow.tracking.loops.keypoints import Index, match_keypoints
from aquaflow.tracking.pose.pnp import pose_from_scratch
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem, solve_pose

Array = npt.NDArray[np.float64]

GRID = (8, 6)
"""Cells of the picture, across and down, in which inliers are counted as spread."""


@dataclass(frozen=True)
class Verified:
    """A place found again: the pose of the frame at the keyframe, and what speaks for it."""

    estimate: PoseEstimate
    """``estimate.T`` is T_fk: keyframe to frame. With the frame's own pointmap its scale is free,
    and the covariance has the seventh row for it."""
    inliers: int
    """Keypoints that agree on the pose."""
    matched: int
    """Keypoints whose descriptors agree and whose depth the keyframe knows."""
    cells: int
    """Cells of the frame's picture, of 48, that hold an inlier."""


def verify(
    keyframe: Keyframe,
    encoding: Encoding,
    camera: CameraModel,
    config: VerificationConfig,
    pointmap: Pointmap | None = None,
) -> Verified | None:
    """The frame's pose at the keyframe, or None where the keypoints do not prove one.

    ``pointmap`` is the frame's own, where it has one: then the two pointmaps' scales are compared
    too, and a pair whose scales are not known to ``max_scale_sigma`` is no proof.
    """
    past = depths_at(keyframe.encoding.keypoints, keyframe.pointmap)
    own = None if pointmap is None else depths_at(encoding.keypoints, pointmap)
    return verify_keypoints(past, encoding.keypoints, camera, config, own)


def verify_keypoints(
    past: KeypointDepths,
    keypoints: Keypoints,
    camera: CameraModel,
    config: VerificationConfig,
    own: KeypointDepths | None = None,
) -> Verified | None:
    """As :func:`verify`, of keypoints alone: ``own`` are the frame's ``keypoints`` with depths."""
    mine, theirs = match_keypoints(past.keypoints, keypoints)
    kept = past.is_known(config.known_sigma)[mine]
    mine, theirs = mine[kept], theirs[kept]
    if len(mine) < config.min_inliers:
        return None
    pixels = keypoints.pixels[theirs].astype(np.float64)
    problem = PoseProblem(
        past.points()[mine], past.variance[mine], pixels, np.ones(len(mine)), camera,
        config.sigma_px,
    )  # fmt: skip
    initial = pose_from_scratch(problem)
    estimate = None if initial is None else solve_pose(problem, initial)
    if estimate is None:
        return None
    error = np.linalg.norm(camera.project(estimate.T.apply(problem.points)) - pixels, axis=1)
    inlier = error < config.inlier_px
    cells = _occupied_cells(pixels[inlier], camera)
    enough = inlier.sum() >= config.min_inliers and inlier.mean() >= config.min_inlier_share
    if not enough or cells < config.min_cells:
        return None
    if own is not None:
        estimate = _with_scale(past, own, (mine[inlier], theirs[inlier]), estimate, config)
        if estimate is None:
            return None
    return Verified(estimate, int(inlier.sum()), len(pixels), cells)


def _with_scale(
    past: KeypointDepths,
    own: KeypointDepths,
    inliers: tuple[Index, Index],  # keypoints of past and own, [M] each
    estimate: PoseEstimate,
    config: VerificationConfig,
) -> PoseEstimate | None:
    """The similarity between the two pointmaps; None where its scale stays unknown."""
    mine, theirs = inliers
    known = own.is_known(config.known_sigma)[theirs]
    if known.sum() < config.min_inliers:
        return None
    points = past.points()[mine]
    own_points = np.where(known[:, None], own.points()[theirs], np.nan)
    problem = PoseProblem(
        points,
        past.variance[mine],
        own.keypoints.pixels[theirs].astype(np.float64),
        np.ones(len(mine)),
        own.camera,
        config.sigma_px,
        frame_points=own_points,
        frame_rho_variance=np.where(known, own.variance[theirs], np.nan),
    )
    # Where the frame's pointmap has another unit, the pose found so far is that far off in depth.
    ratio = own_points[known][:, 2] / estimate.T.apply(points[known])[:, 2]
    scale = float(np.median(ratio))
    start = Sim3(estimate.T.R, scale * estimate.T.t, scale)
    similar = solve_pose(problem, start, free_scale=True)
    if similar is None or similar.covariance[6, 6] > config.max_scale_sigma**2:
        return None
    return similar


def _occupied_cells(
    pixels: Array,  # [M, 2] px
    camera: CameraModel,
) -> int:
    share = pixels / (camera.width, camera.height)
    cell = np.floor(np.clip(share, 0.0, 1.0 - 1e-9) * GRID).astype(np.int64)
    return len(np.unique(cell @ (1, GRID[0])))
