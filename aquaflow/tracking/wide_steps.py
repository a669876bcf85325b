"""What is tried after a wide step, and only then: other poses, new depth, other keyframes.

Flow follows a step that is small against the picture, and against the distance after which the
picture repeats itself. Beyond that, several starts of the flow are compared by how much of the
picture they explain.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import (
    MIN_MATCHES,
    pose_candidates,
    rotation_compensated_parallax_px,
)
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.prior.contract import Encoding, Mask, PairGeometry, Prior
from aquaflow.tracking.loops import match_keypoints
from aquaflow.tracking.pose.depth_fusion import fuse
from aquaflow.tracking.pose.matcher import (
    KeyframeMatcher,
    Matched,
    expected_matches,
    is_wide,
    matched_share,
    pose_from_scratch,
    pose_problem,
)
from aquaflow.tracking.pose.solver import PoseProblem

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
        known = pointmap.is_known(config.known_sigma)
        for pair in self._surest_first(pointmap, reference, encoding, camera, predicted):
            if matched_share(keyframe.encoding, pair) < RECOVERED_SUPPORT:
                continue
            T_fk = turning_step(pointmap, pair, known, camera, predicted)
            if T_fk is not None and not self._is_denied(keyframe, encoding, camera, T_fk):
                fuse(pointmap, pair, T_fk, camera, config.sigma_px)
                return self._matcher.pose(keyframe, camera, pair, T_fk, T_fk)
        return None

    def _is_denied(
        self, keyframe: Keyframe, encoding: Encoding, camera: CameraModel, T_fk: Sim3
    ) -> bool:
        """True if keypoints, which have no double and took no part in the pose, are elsewhere:
        matches that are tiles off all the way agree with each other."""
        pixels_k, pixels = known_keypoints(keyframe, encoding, self._config.known_sigma)
        if len(pixels) < LEAST_INLIERS:
            return False
        problem = pose_problem(keyframe.pointmap, pixels_k, pixels, camera, SIGMA_PX)
        agree = keypoint_error_px(problem, T_fk) < AGREEING_WIDTHS * camera.width
        return bool(agree.mean() < LEAST_AGREEING)

    def _surest_first(
        self,
        pointmap: Pointmap,
        reference: Encoding,
        encoding: Encoding,
        camera: CameraModel,
        predicted: Sim3,
    ) -> list[PairGeometry]:
        """Flows from nothing, and from where the motion so far puts the keyframe's pixels, as far
        away as those around or without end; without those that agree by chance."""
        pairs = [self._prior.decode(reference, encoding)]
        for pose in (predicted, Sim3(predicted.R, np.zeros(3))):
            seed = expected_matches(pointmap, pose, camera)
            pairs.append(self._prior.decode(reference, encoding, seed, alone=True))
        sure = [pair for pair in pairs if not match_by_chance(pair)]
        return sorted(sure, key=lambda pair: -float(pair.C[pair.valid].sum()))

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


Array = npt.NDArray[np.float64]

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
AGREEING_WIDTHS = 0.025
"""Reprojection error, of the picture's width, of a keypoint that does not deny a pose: a wide step
from depths just found is up to 0.02 off, and a tile 0.05 and more (real pool, 480 and 640 px)."""
LEAST_AGREEING = 0.25
"""Of the keypoints of known depth, those that agree with a pose, below which they deny it: 0.07 and
0.09 over a jump of 12 s on the real pool, 0.55 of the worst right pose there."""


def keypoint_poses(
    keyframe: Keyframe, encoding: Encoding, camera: CameraModel, known_sigma: float
) -> list[Sim3]:
    """T_fk, best supported first; empty where the keypoints agree on none."""
    pixels_k, pixels = known_keypoints(keyframe, encoding, known_sigma)
    poses: list[Sim3] = []
    while len(poses) < HYPOTHESES and len(pixels) >= LEAST_INLIERS:
        problem = pose_problem(keyframe.pointmap, pixels_k, pixels, camera, SIGMA_PX)
        pose = pose_from_scratch(problem, LEAST_INLIERS)
        if pose is None:
            break
        poses.append(pose)
        rest = keypoint_error_px(problem, pose) >= INLIER_PX
        if rest.all():
            break
        pixels_k, pixels = pixels_k[rest], pixels[rest]
    return poses


def known_keypoints(
    keyframe: Keyframe, encoding: Encoding, known_sigma: float
) -> tuple[Array, Array]:
    """[M, 2] px each: the keyframe's keypoints of known depth, and where a frame has them."""
    mine, theirs = match_keypoints(keyframe.encoding.keypoints, encoding.keypoints)
    pixels_k = keyframe.encoding.keypoints.pixels[mine].astype(np.float64)
    known = at_pixels(keyframe.pointmap.is_known(known_sigma), pixels_k)
    return pixels_k[known], encoding.keypoints.pixels[theirs[known]].astype(np.float64)


def keypoint_error_px(problem: PoseProblem, T_fk: Sim3) -> Array:
    """[M] distance of keypoints from where a pose puts them."""
    there = problem.camera.project(T_fk.apply(problem.points))
    return np.asarray(np.linalg.norm(there - problem.pixels, axis=1))


# --------------------------------------------------------------------------------------------------
# A step into a part of the scene whose depth the keyframe does not know yet.
#
# A camera that turns by half its view between two pictures shows, in the second one, what the first
# one has just come to see: nothing there has a depth that a pose could be solved from. Matches
# alone give the rotation and the direction of the step; its length comes from the few points that
# are known or, without any, from the step before.

MATCHES = 1500
"""Matches that the two-view pose is estimated from."""
LEAST_PARALLAX_PX = 1.5
"""What the best pure rotation leaves unexplained: less, and there is no direction to find."""
LEAST_SUPPORT = 0.6
"""Matches that triangulate well under the pose; of unrelated pictures a third do."""
LEAST_CONFIDENCE = 0.012
"""Mean of the matches', below which they agree by chance: 0.002 to 0.01 of pictures of other places
and of matches that are tiles off, 0.016 and more of right ones (synthetic pools at 160 px), 0.12
and more from picture to picture of real clips."""
AS_GOOD = 0.9
"""Support over the best one's of a pose that may be the right one too, as over a plane."""
KNOWN_POINTS = 30
"""Points of known depth that a length is taken from."""
LENGTH_SPREAD = 0.3
"""Median absolute deviation over median of the lengths that these points ask for."""
MOST_CHANGE = 3.0
"""Ratio of two steps in a row."""


def match_by_chance(pair: PairGeometry) -> bool:
    """True of matches of other places, or of tiles that are not the same one."""
    certain = pair.C[pair.valid]
    return certain.size == 0 or float(certain.mean()) < LEAST_CONFIDENCE


def turning_step(
    pointmap: Pointmap,
    pair: PairGeometry,
    known: Mask,  # [H, W] pixels of the keyframe whose depth is good
    camera: CameraModel,
    predicted: Sim3,
) -> Sim3 | None:
    """T_fk in the keyframe's unit, from matches; ``predicted`` is where the motion before leads to.

    None where too few matches agree on a pose, or nothing says how long the step was.
    """
    pixels_k, pixels = _matches(pair, pair.valid)
    if len(pixels) < MIN_MATCHES:
        return None
    if rotation_compensated_parallax_px(pixels_k, pixels, camera) < LEAST_PARALLAX_PX:
        return None
    candidates = pose_candidates(pixels_k, pixels, pointmap.camera, camera)
    if not candidates or candidates[0].support < LEAST_SUPPORT:
        return None
    likely = [c.T_ba for c in candidates if c.support >= AS_GOOD * candidates[0].support]
    T = max(likely, key=lambda each: float(each.t @ predicted.t))
    length = _length(pointmap, *_matches(pair, pair.valid & known), camera, T)
    usual = float(np.linalg.norm(predicted.t))
    if length is None:
        length = usual
    elif usual > 0.0 and not 1.0 / MOST_CHANGE < length / usual < MOST_CHANGE:
        return None
    return Sim3(T.R, length * T.t) if length > 0.0 else None


def _matches(
    pair: PairGeometry,
    which: Mask,  # [H, W]
) -> tuple[Array, Array]:
    """[M, 2] px each: about ``MATCHES`` pixels of the keyframe at most, evenly taken, and where
    they are seen."""
    rows, columns = np.nonzero(which)
    step = max(1, len(rows) // MATCHES)
    rows, columns = rows[::step], columns[::step]
    return np.stack([columns + 0.5, rows + 0.5], -1), pair.matches[rows, columns].astype(np.float64)


def _length(
    pointmap: Pointmap,
    pixels_k: Array,  # [M, 2] px, of known depth
    pixels: Array,  # [M, 2] px, where they are seen
    camera: CameraModel,
    T: Sim3,
) -> float | None:
    """How long the step along T.t is by the known points; None where they do not agree."""
    if len(pixels_k) < KNOWN_POINTS:
        return None
    points = pointmap.camera.unproject(pixels_k) / at_pixels(pointmap.rho, pixels_k)[:, None]
    rays = camera.unproject(pixels)
    # rays x (R points + length t) = 0, by least squares for each point.
    turned, along = np.cross(rays, points @ T.R.T), np.cross(rays, T.t)
    strength = (along * along).sum(-1)
    lengths = -(turned * along).sum(-1) / np.maximum(strength, 1e-12)
    length = float(np.median(lengths))
    spread = float(np.median(np.abs(lengths - length)))
    return length if length > 0.0 and spread < LENGTH_SPREAD * length else None
