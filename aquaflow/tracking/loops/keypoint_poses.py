"""Poses that the keypoints of two pictures speak for, the best distinct ones.

Flow that starts a tile off holds on to the neighbour and comes back from there: most of a tiled
floor matches, one tile off. Keypoints that have no double, which the ratio test keeps, say where
flow has to start. Where two sets of them contradict each other, both poses are kept until dense
matches decide.
"""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.pixels import at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.loops.keypoints import match_keypoints
from aquaflow.tracking.pose.pnp import pose_from_scratch
from aquaflow.tracking.pose.problem import pose_problem

HYPOTHESES = 2
"""Each costs one dense matching."""
LEAST_INLIERS = 12
"""Keypoints that agree on a pose; dense matches test it afterwards."""
INLIER_PX = 4.0
"""Reprojection error of a keypoint that speaks for a pose already found."""
SIGMA_PX = 1.0
"""Noise of a keypoint at wide baseline."""


def keypoint_poses(
    keyframe: Keyframe, encoding: Encoding, camera: CameraModel, known_sigma: float
) -> list[Sim3]:
    """T_fk, best supported first; empty where the keypoints agree on none."""
    mine, theirs = match_keypoints(keyframe.encoding.keypoints, encoding.keypoints)
    pixels_k = keyframe.encoding.keypoints.pixels[mine].astype(np.float64)
    pixels = encoding.keypoints.pixels[theirs].astype(np.float64)
    left = at_pixels(keyframe.pointmap.known(known_sigma), pixels_k)
    poses: list[Sim3] = []
    while len(poses) < HYPOTHESES and left.sum() >= LEAST_INLIERS:
        problem = pose_problem(keyframe.pointmap, pixels_k[left], pixels[left], camera, SIGMA_PX)
        pose = pose_from_scratch(problem, LEAST_INLIERS)
        if pose is None:
            break
        poses.append(pose)
        error = np.linalg.norm(camera.project(pose.apply(problem.points)) - problem.pixels, axis=1)
        rest = left.copy()
        rest[left] = error >= INLIER_PX
        if rest.sum() == left.sum():
            break
        left = rest
    return poses
