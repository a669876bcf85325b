"""One frame against one keyframe: matches, pose, and whether both are reliable."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.prior.contract import Encoding, Float, Mask, PairGeometry
from aquaflow.tracking.frames import Quality
from aquaflow.tracking.learned.scaling import learned_depth
from aquaflow.tracking.pose.pnp import pose_from_scratch
from aquaflow.tracking.pose.problem import pose_problem
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem, solve_pose
from aquaflow.tracking.pose.surroundings import surroundings
from aquaflow.tracking.pose.visibility import Visibility, evenly_taken, visibility

LEAST_TRIANGULATED = 0.3
"""Of the matches of known depth, those triangulated, below which learned depths take part in
poses."""


@dataclass(frozen=True)
class Matched:
    """A frame that was placed against a keyframe."""

    estimate: PoseEstimate
    """``estimate.T`` is T_fk: keyframe to frame."""
    pair: PairGeometry
    share: float
    """Matched part of what the keyframe shows."""
    parallax_px: float
    """Mean displacement of the matches."""
    points: npt.NDArray[np.float64]
    """[M, 3] of the keyframe that the pose was solved from."""
    visibility: Visibility
    known_share: float
    """Of the matches, those whose depth is triangulated."""

    @property
    def support(self) -> float:
        """Part of what the keyframe shows that is matched where the pose says."""
        return self.share * self.estimate.inlier_share

    @property
    def explained(self) -> float:
        """Support, times the part of what the pose puts into view that is matched there: between
        tiles, a pose that is one of them off matches more, but not what it should."""
        return self.support * self.visibility.seen

    @property
    def quality(self) -> Quality:
        """Quality of the pose."""
        estimate = self.estimate
        return Quality(
            estimate.inlier_share, estimate.residual_px, self.share, estimate.conditioning
        )


class KeyframeMatcher:
    """Poses from a prior's matches and a keyframe's pointmap (paper, Eq. 3)."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config

    def pose(
        self,
        keyframe: Keyframe,
        camera: CameraModel,
        pair: PairGeometry,
        predicted: Sim3,
        fallback: Sim3,
    ) -> Matched | None:
        """The pose from ``predicted``; from the matches alone, or from ``fallback``, where that
        fails; None where too few matches support one."""
        config, pointmap = self._config, self._depths(keyframe.pointmap, pair)
        around, known = surroundings(pointmap, config.known_sigma)
        problem, pixels_k = self._problem(pointmap, pair, camera, around, known)
        if len(problem.points) < config.min_matches:
            return None
        estimate = self._solve(problem, predicted)
        if estimate is None or estimate.inlier_share < config.min_inlier_share:
            estimate = self._solve(problem, pose_from_scratch(problem) or fallback)
        if estimate is None or estimate.inlier_share < config.min_inlier_share:
            return None
        share = matched_share(keyframe.encoding, pair)
        if share * estimate.inlier_share < config.min_support:
            return None
        displacement = np.linalg.norm(problem.pixels - pixels_k, axis=1)
        # What is hidden shows against depths that are right: learned ones put points elsewhere.
        triangulated = keyframe.pointmap
        exact = known if pointmap is triangulated else triangulated.is_known(config.known_sigma)
        visible = visibility(
            triangulated,
            keyframe.encoding.interesting & exact,
            pair.matches,
            pair.valid,
            estimate.T,
            camera,
        )
        parallax_px = float(displacement.mean())
        both, every = (int(np.count_nonzero(m)) for m in (pair.valid & exact, pair.valid))
        known_share = both / max(every, 1)
        return Matched(estimate, pair, share, parallax_px, problem.points, visible, known_share)

    def _depths(self, pointmap: Pointmap, pair: PairGeometry) -> Pointmap:
        """The depths that poses are solved from: triangulated ones, and learned ones only where few
        of the matches have others. A network's error is that of whole parts of a picture."""
        if pointmap.learned is None:
            return pointmap
        known_sigma, least = self._config.known_sigma, LEAST_TRIANGULATED
        triangulated = (pair.valid & pointmap.is_known(known_sigma)).sum()
        if triangulated >= least * pair.valid.sum():
            return pointmap
        completed = pointmap.complete(known_sigma)
        every = (pair.valid & completed.is_known(known_sigma)).sum()
        return completed if triangulated < least * every else pointmap

    def _solve(self, problem: PoseProblem, initial: Sim3) -> PoseEstimate | None:
        """By the residual that was asked for; between pictures whose own points have no common unit
        yet, by pixels."""
        residual = self._config.residual
        if residual == "point" and problem.frame_points is None:
            residual = "pixel"
        return solve_pose(problem, initial, self._config.stop_converged, residual)

    def _problem(
        self,
        pointmap: Pointmap,
        pair: PairGeometry,
        camera: CameraModel,
        around: Float,  # [H, W]
        known: Mask,  # [H, W]
    ) -> tuple[PoseProblem, npt.NDArray[np.float64]]:
        """At most ``matches`` matches whose depth is known, and their keyframe pixels."""
        rows, columns = evenly_taken(pair.valid & known, self._config.matches)
        pixels_k = np.stack([columns + 0.5, rows + 0.5], -1)
        pixels = pair.matches[rows, columns].astype(np.float64)
        weights = pair.C[rows, columns].astype(np.float64)
        sigma_px = self._config.sigma_px
        problem = pose_problem(pointmap, pixels_k, pixels, camera, sigma_px, weights)
        around_rho = around[rows, columns].astype(np.float64)
        problem = replace(problem, around_rho=around_rho)
        if self._config.residual == "point":
            known_sigma = self._config.known_sigma
            own = own_points(pointmap, pair, pixels, camera, known_sigma)
            if own is not None:
                problem = replace(
                    problem, frame_points=own.points, frame_rho_variance=own.rho_variance
                )
        return problem, pixels_k


def matched_share(encoding: Encoding, pair: PairGeometry) -> float:
    """min(valid matches, distinct matched pixels) over the sampled pixels (docs/paper.md)."""
    looked_at = encoding.interesting
    matched = looked_at & pair.valid
    column, row = np.moveaxis(pair.matches, -1, 0)
    targets = row[matched].astype(np.int32) * looked_at.shape[1] + column[matched].astype(np.int32)
    hit = np.zeros(looked_at.size, bool)
    hit[targets] = True
    matches, pixels, all_pixels = (int(np.count_nonzero(m)) for m in (matched, hit, looked_at))
    return min(matches, pixels) / max(all_pixels, 1)


# --------------------------------------------------------------------------------------------------
# A frame's own points, as the prior has them, for residuals between pointmaps (paper, Eq. 3).

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OwnPoints:
    """Points of a frame at given pixels, in the keyframe's unit."""

    points: Array
    """[M, 3] in the frame's camera; NaN where unknown"""
    rho_variance: Array
    """[M] of their inverse depths"""


def own_points(
    pointmap: Pointmap,
    pair: PairGeometry,
    pixels: Array,  # [M, 2] px in the frame
    camera: CameraModel,
    known_sigma: float,
) -> OwnPoints | None:
    """X of the frame, seen by ``camera``, at ``pixels``. The prior has both pictures' points in one
    unit, and the keyframe's ``pointmap`` says which; None without ranges, or without that unit."""
    if pair.range_unit != "shared":
        return None
    if pair.X_a is None or pair.Q_a is None or pair.X_b is None or pair.Q_b is None:
        return None
    keyframe = learned_depth(pointmap, pair.X_a, pair.Q_a, known_sigma)
    if keyframe is None:
        return None
    Q = at_pixels(pair.Q_b, pixels).astype(np.float64)
    z = at_pixels(pair.X_b[..., 2], pixels) * np.exp(keyframe.log_scale)
    known = np.isfinite(z) & (z > 0.0) & (Q > 0.0)
    rho = 1.0 / np.where(known, z, 1.0)
    rays = camera.unproject(pixels)
    variance = keyframe.honesty**2 / np.where(known, Q, 1.0) * rho**2
    return OwnPoints(np.where(known[:, None], rays * z[:, None], np.nan), variance)
