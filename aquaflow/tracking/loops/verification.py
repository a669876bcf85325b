"""Is this the same place? A pose from keypoints alone, and whether chance could have made it.

Dense flow finds a tenth of a picture in any other picture, and nothing in the same one turned
round. Keypoints do neither: between pictures of different places some ten descriptors agree, and
their pixels agree on no pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aquaflow.config import VerificationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.pixels import at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.loops.keypoints import match_keypoints
from aquaflow.tracking.pose.pnp import pose_from_scratch
from aquaflow.tracking.pose.problem import Array, pose_problem
from aquaflow.tracking.pose.solver import PoseEstimate, solve_pose

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
    mine, theirs = match_keypoints(keyframe.encoding.keypoints, encoding.keypoints)
    pixels_k = keyframe.encoding.keypoints.pixels[mine].astype(np.float64)
    pixels = encoding.keypoints.pixels[theirs].astype(np.float64)
    known = at_pixels(keyframe.pointmap.known(config.known_sigma), pixels_k)
    pixels_k, pixels = pixels_k[known], pixels[known]
    if len(pixels) < config.min_inliers:
        return None
    problem = pose_problem(keyframe.pointmap, pixels_k, pixels, camera, config.sigma_px)
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
    if pointmap is not None:
        kept = (pixels_k[inlier], pixels[inlier])
        estimate = _with_scale(keyframe.pointmap, pointmap, kept, estimate, config)
        if estimate is None:
            return None
    return Verified(estimate, int(inlier.sum()), len(pixels), cells)


def _with_scale(
    pointmap_k: Pointmap,
    pointmap: Pointmap,
    inliers: tuple[Array, Array],  # pixels in the keyframe and in the frame, [M, 2] each
    estimate: PoseEstimate,
    config: VerificationConfig,
) -> PoseEstimate | None:
    """The similarity between the two pointmaps; None where its scale stays unknown."""
    pixels_k, pixels = inliers
    known = at_pixels(pointmap.known(config.known_sigma), pixels)
    if known.sum() < config.min_inliers:
        return None
    camera = pointmap.camera
    plain = pose_problem(pointmap_k, pixels_k, pixels, camera, config.sigma_px)
    rho = np.where(known, at_pixels(pointmap.rho, pixels), np.nan)
    own = camera.unproject(pixels) / rho[:, None]
    variance = np.where(known, at_pixels(pointmap.variance, pixels), np.nan)
    problem = replace(plain, frame_points=own, frame_rho_variance=variance)
    # Where the frame's pointmap has another unit, the pose found so far is that far off in depth.
    ratio = own[known][:, 2] / estimate.T.apply(plain.points[known])[:, 2]
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
