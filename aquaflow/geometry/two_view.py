"""Relative pose of two calibrated views from matches: essential matrix against homography.

A flat sea floor makes the essential matrix ambiguous, relief makes the homography wrong; both are
estimated, and the caller judges the candidates by how well they explain the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.triangulation import triangulate

Array = npt.NDArray[np.float64]

INLIER_PX = 1.0
"""MAGSAC's threshold for the essential matrix: five times the noise of a refined match (see
prior/flow.py). A homography gets double."""
RANSAC_CONFIDENCE = 0.999
"""Probability of having drawn a sample without outliers."""
MIN_MATCHES = 40
"""Fewer matches than this decide nothing (notes/measurements.md#pose-solver)."""


@dataclass(frozen=True)
class PoseCandidate:
    """A relative pose that may explain two views; the translation has unit length."""

    T_ba: Sim3
    source: str
    """``essential`` or ``homography``."""
    support: float
    """Part of the matches that triangulate well under it."""


def pose_candidates(
    pixels_a: Array,  # [M, 2] px
    pixels_b: Array,  # [M, 2] px
    camera_a: CameraModel,
    camera_b: CameraModel,
) -> list[PoseCandidate]:
    """Poses from the essential matrix and from the homography, best supported first."""
    if len(pixels_a) < MIN_MATCHES:
        return []
    # Both as pixels of one camera centred at 0: MAGSAC goes astray on normalised rays (measured:
    # with 30 % outliers the homography is lost, the essential matrix ten times less accurate).
    rays_a, rays_b = camera_a.unproject(pixels_a), camera_b.unproject(pixels_b)
    K = np.diag([camera_b.fx, camera_b.fx, 1.0])
    a, b = camera_b.fx * rays_a[:, :2], camera_b.fx * rays_b[:, :2]
    poses = _essential_poses(a, b, K) + _homography_poses(a, b, K)
    candidates = []
    for T_ba, source in poses:
        points = triangulate(rays_a, pixels_b, T_ba, camera_b, sigma_px=0.5)
        candidates.append(PoseCandidate(T_ba, source, float(points.good.mean())))
    return sorted(candidates, key=lambda candidate: -candidate.support)


def relative_pose(
    pixels_a: Array,  # [M, 2] px
    pixels_b: Array,  # [M, 2] px
    camera_a: CameraModel,
    camera_b: CameraModel,
) -> Sim3 | None:
    """The best supported relative pose ``T_ba`` (unit translation), or None."""
    candidates = pose_candidates(pixels_a, pixels_b, camera_a, camera_b)
    return candidates[0].T_ba if candidates and candidates[0].support > 0.0 else None


def rotation_compensated_parallax_px(
    pixels_a: Array,  # [M, 2] px
    pixels_b: Array,  # [M, 2] px
    camera: CameraModel,
) -> float:
    """Median displacement, in pixels, that the best pure rotation leaves unexplained.

    The rotation is the orthogonal Procrustes fit between the unit rays (Kabsch), which is what the
    pictures would show if the camera had only turned.
    """
    a = camera.unproject(pixels_a)
    b = camera.unproject(pixels_b)
    ua = a / np.linalg.norm(a, axis=1, keepdims=True)
    ub = b / np.linalg.norm(b, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(ub.T @ ua)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.median(np.linalg.norm(camera.project(ua @ R.T) - pixels_b, axis=1)))


def _essential_poses(
    a: Array,  # [N, 2] px
    b: Array,  # [N, 2] px
    K: Array,  # [3, 3] px
) -> list[tuple[Sim3, str]]:
    import cv2

    E, _ = cv2.findEssentialMat(
        a, b, K, method=cv2.USAC_MAGSAC, prob=RANSAC_CONFIDENCE, threshold=INLIER_PX
    )
    if E is None or E.shape != (3, 3):
        return []
    R1, R2, t = (np.asarray(part, dtype=np.float64) for part in cv2.decomposeEssentialMat(E))
    return [(Sim3(R, sign * t[:, 0]), "essential") for R in (R1, R2) for sign in (1.0, -1.0)]


def _homography_poses(
    a: Array,  # [N, 2] px
    b: Array,  # [N, 2] px
    K: Array,  # [3, 3] px
) -> list[tuple[Sim3, str]]:
    import cv2

    H, _ = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 2.0 * INLIER_PX)
    if H is None:
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, K)
    poses = []
    for R, t in zip(rotations, translations, strict=True):
        direction, length = np.asarray(t[:, 0], dtype=np.float64), float(np.linalg.norm(t))
        if length > 1e-6:
            poses.append((Sim3(np.asarray(R), direction / length), "homography"))
    return poses
