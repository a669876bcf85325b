"""What is tried after a wide step, and only then: other poses, new depth, other keyframes.

Flow follows a step that is small against the picture, and against the distance after which the
picture repeats itself. Beyond that, several starts of the flow are compared by how much of the
picture they explain.
"""

from __future__ import annotations

import numpy as np

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.prior.contract import Encoding, Prior
from aquaflow.prior.flow import pixel_grid
from aquaflow.prior.homography import flow_of_homography, homography
from aquaflow.tracking.loops.keypoints import match_keypoints
from aquaflow.tracking.pose.depth_fusion import fuse
from aquaflow.tracking.pose.expected_matches import expected_matches, is_wide
from aquaflow.tracking.pose.matcher import KeyframeMatcher, Matched, matched_share
from aquaflow.tracking.pose.pnp import pose_from_scratch
from aquaflow.tracking.pose.problem import pose_problem
from aquaflow.tracking.pose.turning_step import turning_step

RECOVERED_SUPPORT = 0.2
"""Matched share x inlier share of a lost frame that is found again in a keyframe left last; twice
``tracking.min_support``."""
CONFIRMED_SEEN = 0.8
"""Of what a pose puts into view, the share matched there from which it is not looked at again."""


class WideSteps:
    """Poses of frames that flow from the last frame's matches does not explain."""

    def __init__(self, prior: Prior, matcher: KeyframeMatcher, config: TrackingConfig) -> None:
        self._prior, self._matcher, self._config = prior, matcher, config

    def doubtful(
        self,
        keyframe: Keyframe,
        solved: Matched | None,
        T_before: Sim3,
        predicted: Sim3,
        camera: CameraModel,
    ) -> bool:
        """True without a pose, and for one that many matches contradict where the step from
        ``T_before`` was wide, or should have been: flow that is a tile off may say that nothing
        moved."""
        if solved is None:
            return True
        if solved.estimate.inlier_share >= self._config.sure_inlier_share:
            return False
        steps = solved.estimate.T, predicted
        return any(is_wide(keyframe.pointmap, T_before, step, camera) for step in steps)

    def is_contradicted(self, solved: Matched) -> bool:
        """True if much of what the pose puts into view is not matched there."""
        return (
            solved.visibility.seen < CONFIRMED_SEEN
            and solved.estimate.inlier_share < self._config.sure_inlier_share
        )

    def confirm(
        self,
        keyframe: Keyframe,
        reference: Encoding,
        encoding: Encoding,
        camera: CameraModel,
        solved: Matched,
        predicted: Sim3,
    ) -> Matched:
        """``solved``, or what flow finds that starts where its pose, or the one ``predicted``, puts
        the keyframe's pixels, whichever is supported best."""
        for pose in (solved.estimate.T, predicted):
            rival = self._from_pose(keyframe, reference, encoding, camera, pose)
            if rival is not None and rival.explained > solved.explained:
                solved = rival
            if not self.is_contradicted(solved):
                break
        return solved

    def _from_pose(
        self,
        keyframe: Keyframe,
        reference: Encoding,
        encoding: Encoding,
        camera: CameraModel,
        pose: Sim3,
    ) -> Matched | None:
        """The pose from matches that are looked for only where ``pose`` puts them."""
        seed = expected_matches(keyframe.pointmap, pose, camera)
        pair = self._prior.decode(reference, encoding, seed, alone=True)
        return self._matcher.pose(keyframe, camera, pair, pose, pose)

    def best(
        self,
        keyframe: Keyframe,
        reference: Encoding,
        encoding: Encoding,
        camera: CameraModel,
        solved: Matched | None,
        predicted: Sim3,
    ) -> Matched | None:
        """``solved``, unless dense matches support another pose better, which keypoints or the
        motion so far speak for."""
        best, poses = solved, keypoint_poses(keyframe, encoding, camera, self._config.known_sigma)
        for pose in [*poses, predicted]:
            rival = self._from_pose(keyframe, reference, encoding, camera, pose)
            if rival is not None and (best is None or rival.explained > best.explained):
                best = rival
            if best is not None and best.estimate.inlier_share >= self._config.sure_inlier_share:
                break
        return best

    def after_turn(
        self,
        keyframe: Keyframe,
        reference: Encoding,
        encoding: Encoding,
        camera: CameraModel,
        predicted: Sim3,
    ) -> Matched | None:
        """The pose of a frame that shows what of the keyframe has no depth yet, which it gets from
        this pair of views; the keyframe must be the one held."""
        pointmap, config = keyframe.pointmap, self._config
        H = homography(reference.keypoints, encoding.keypoints)
        if H is None:
            return None
        height, width = pointmap.rho.shape
        seed = pixel_grid(height, width) + flow_of_homography(H, height, width)
        pair = self._prior.decode(reference, encoding, seed)
        if matched_share(keyframe.encoding, pair) < RECOVERED_SUPPORT:
            return None
        known = pointmap.is_known(config.known_sigma)
        T_fk = turning_step(pointmap, pair, known, camera, predicted)
        if T_fk is None:
            return None
        fuse(pointmap, pair, T_fk, camera, config.sigma_px)
        return self._matcher.pose(keyframe, camera, pair, T_fk, T_fk)

    def shown_by(
        self, keyframe: Keyframe, encoding: Encoding, camera: CameraModel
    ) -> Matched | None:
        """The pose of a lost frame at a keyframe that shows its place: keypoints say where, dense
        matches whether."""
        for pose in keypoint_poses(keyframe, encoding, camera, self._config.known_sigma):
            seed = expected_matches(keyframe.pointmap, pose, camera)
            pair = self._prior.decode(keyframe.encoding, encoding, seed)
            solved = self._matcher.pose(keyframe, camera, pair, pose, pose)
            if solved is not None and solved.support >= RECOVERED_SUPPORT:
                return solved
        return None


# --------------------------------------------------------------------------------------------------
# Poses that the keypoints of two pictures speak for, the best distinct ones.
#
# Flow that starts a tile off holds on to the neighbour and comes back from there: most of a tiled
# floor matches, one tile off. Keypoints that have no double, which the ratio test keeps, say where
# flow has to start. Where two sets of them contradict each other, both poses are kept until dense
# matches decide.

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
    left = at_pixels(keyframe.pointmap.is_known(known_sigma), pixels_k)
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
