"""Two calibrated views: their relative pose from matches, epipolar distances, and depth.

A flat sea floor makes the essential matrix ambiguous, relief makes the homography wrong; both are
estimated, and the caller judges the candidates by how well they explain the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, hat

Array = npt.NDArray[np.float64]

INLIER_PX = 1.0
"""MAGSAC's threshold for the essential matrix: five times the noise of a refined match (see
prior/flow.py). A homography gets double."""
RANSAC_CONFIDENCE = 0.999
"""Probability of having drawn a sample without outliers."""
MIN_MATCHES = 40
"""Fewer matches than this decide nothing (notes/2026-11-tracking.md#pose-solver)."""


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


# --------------------------------------------------------------------------------------------------
# How far matches lie from each other's epipolar lines under a relative pose.

LEAST_GRADIENT = 1e-12
"""Of the constraint; a match at the epipole satisfies every pose."""


def epipolar_distances(
    rays_a: Array,  # [M, 3] z = 1
    rays_b: Array,  # [M, 3] z = 1
    T_ba: Sim3,
) -> Array:
    """[M] Sampson distances, in units of the normalised plane.

    To first order the least move of both points that meets the constraint (P. D. Sampson, "Fitting
    conic sections to very scattered data", 1982). Neither depths nor the scale of ``T_ba`` matter.
    """
    t = T_ba.t / max(float(np.linalg.norm(T_ba.t)), LEAST_GRADIENT)
    E = hat(t) @ T_ba.R
    lines_b, lines_a = rays_a @ E.T, rays_b @ E
    constraint = (rays_b * lines_b).sum(axis=1)
    gradient = np.hypot(
        np.linalg.norm(lines_a[:, :2], axis=1), np.linalg.norm(lines_b[:, :2], axis=1)
    )
    return np.asarray(np.abs(constraint) / np.maximum(gradient, LEAST_GRADIENT))


# --------------------------------------------------------------------------------------------------
# Depth of matched pixels from two known views, with the uncertainty that the parallax allows.

MIN_PARALLAX_RAD = np.radians(0.15)
"""Below this angle a depth from two views is noise (notes/2026-11-tracking.md#pose-solver)."""

MAX_REPROJECTION_PX = 1.5
"""A match further than this from its epipolar line is an outlier, not a measurement."""

MIN_DEPTH = 1e-3
"""Nearer points, and those behind a camera, are no measurement."""

MIN_RHO, MAX_RHO = 1e-9, 1e6
"""Inverse depths outside are no measurement; held there, their inverse is finite."""

MIN_CROSS_SQ = 1e-12
"""Squared sine of the angle below which rays are parallel: their depth is rounding noise."""


@dataclass(frozen=True)
class Triangulation:
    """Inverse depths in view a, one per match."""

    rho: Array
    """[M] 1 / z in a."""
    variance: Array
    """[M] variance of ``rho``."""
    good: npt.NDArray[np.bool_]
    """[M] in front of both cameras, enough parallax, close to the epipolar line."""
    sin_parallax: Array
    """[M] sine of the angle between the two rays."""


def triangulate(
    rays_a: Array,  # [M, 3], z = 1, camera a
    pixels_b: Array,  # [M, 2] px
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
    expected_rho: Array | None = None,  # [M] 1 / z in a; 0 where nothing is expected
) -> Triangulation:
    """Point on each ray of a that is nearest to the matched ray of b.

    The variance is first order: ``sigma_px`` along the epipolar line moves the inverse depth by
    (sigma / f) * rho / sin(parallax). It and the parallax are taken at ``expected_rho`` where there
    is one: taken at the measurement, noise would choose its own weight, the nearer the surer, and
    far points of a forward view would come out near.
    """
    # One array for each coordinate: several times faster than [M, 3] arrays, and it is the frame's
    # whole picture that comes through here.
    xa, ya = rays_a[:, 0], rays_a[:, 1]
    xb, yb = (
        (pixels_b[:, 0] - camera_b.cx) / camera_b.fx,
        (pixels_b[:, 1] - camera_b.cy) / camera_b.fy,
    )
    ax, ay, az = (row[0] * xa + row[1] * ya + row[2] for row in T_ba.R)
    t_ba = T_ba.in_source_unit().t
    tx, ty, tz = t_ba
    # x_b ~ a_in_b + rho t  =>  x_b x (a_in_b + rho t) = 0, solved for rho by least squares. Solved
    # for z, the noise of x_b would be in the divisor, and every depth too small by its variance.
    cx, cy, cz = yb * az - ay, ax - xb * az, xb * ay - yb * ax
    dx, dy, dz = yb * tz - ty, tx - xb * tz, xb * ty - yb * tx
    cc = cx * cx + cy * cy + cz * cz
    dd = dx * dx + dy * dy + dz * dz
    rho = -(cx * dx + cy * dy + cz * dz) / np.maximum(dd, 1e-18)
    z_safe = 1.0 / np.clip(rho, MIN_RHO, MAX_RHO)

    expected_z = z_safe
    if expected_rho is not None:
        expected_z = np.where(
            expected_rho > MIN_RHO, 1.0 / np.maximum(expected_rho, MIN_RHO), z_safe
        )
    sine = _sin_parallax(xa, ya, expected_z, -(T_ba.R.T @ t_ba))
    in_b_z = z_safe * az + tz
    inverse = 1.0 / np.maximum(in_b_z, MIN_DEPTH)
    off_u = camera_b.fx * ((z_safe * ax + tx) * inverse - xb)
    off_v = camera_b.fy * ((z_safe * ay + ty) * inverse - yb)
    good = (rho > MIN_RHO) & (z_safe > MIN_DEPTH) & (in_b_z > MIN_DEPTH)
    good &= off_u * off_u + off_v * off_v < MAX_REPROJECTION_PX**2
    # Parallel rays meet nowhere; their z is rounding noise over the guard.
    good &= (sine > np.sin(MIN_PARALLAX_RAD)) & (cc > MIN_CROSS_SQ)
    sigma = (sigma_px / camera_b.fx) / (expected_z * np.maximum(sine, 1e-6))
    return Triangulation(1.0 / z_safe, sigma * sigma, good, sine)


def _sin_parallax(
    x: Array,  # [M]
    y: Array,  # [M]
    z: Array,  # [M] depth
    centre: Array,  # [3] of camera b in a
) -> Array:
    """[M] between the ray (x, y, 1) z of a and the line from b's centre to its end."""
    # ray x (z ray - centre) = -ray x centre, whatever z is.
    cx, cy, cz = centre
    ux, uy, uz = y * cz - cy, cx - x * cz, x * cy - y * cx
    across_sq = ux * ux + uy * uy + uz * uz
    along = z * (x * x + y * y + 1.0) - (x * cx + y * cy + cz)
    return np.asarray(np.sqrt(across_sq / np.maximum(across_sq + along * along, 1e-300)))
