"""Lens distortion by OpenCV's models: distorted pixels of rays, and rays of distorted pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel

NEWTON_ITERATIONS = 50
"""Limit of the search for the point that is distorted to a given one."""
CONVERGED = 1e-15
"""Step at z = 1 after which none changes the point."""
MAX_UNDISTORTION_ERROR_PX = 0.01
"""Error up to which that search counts as successful; beyond, the lens model has no inverse
there."""


def distort_points(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Distorted pixels [M, 2] of the rays through ``points``; NaN stays NaN."""
    import cv2

    if not camera.is_distorted:
        return camera.project(np.concatenate([points, np.ones((len(points), 1))], axis=1))
    if camera.distortion_model == "radtan":
        return _distort(points, camera)[0]
    coefficients = camera.coefficients
    pixels = cv2.fisheye.distortPoints(points[:, None], camera.K, coefficients)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def undistort_points(
    pixels: npt.NDArray[np.float64],  # [M, 2] px, distorted
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Points [M, 2] at z = 1 on the rays of distorted pixels; NaN where there is no such ray.

    OpenCV's own inverse of ``radtan`` stops after five rounds, pixels away at wide corners.
    """
    import cv2

    if not camera.is_distorted:
        return camera.unproject(pixels)[:, :2]
    coefficients = camera.coefficients
    if camera.distortion_model == "fisheye":
        points = cv2.fisheye.undistortPoints(pixels[:, None], camera.K, coefficients)[:, 0]
        # OpenCV marks what did not converge with -1e6.
        lost = np.abs(points).max(1, keepdims=True) > 1e5
        return np.where(lost, np.nan, points).astype(np.float64)
    points = camera.unproject(pixels)[:, :2]
    for _ in range(NEWTON_ITERATIONS):
        found, J = _distort(points, camera)
        error = np.nan_to_num(found - pixels, posinf=1e9, neginf=-1e9)
        step = np.einsum("nij,nj->ni", np.linalg.pinv(J), error)
        # Half a radian at most: far out the polynomial sends Newton anywhere.
        points = points - step / np.maximum(1.0, 2.0 * np.linalg.norm(step, axis=1))[:, None]
        if np.abs(step).max(initial=0.0) < CONVERGED:
            break
    found, _ = _distort(points, camera)
    close = np.linalg.norm(found - pixels, axis=1) < MAX_UNDISTORTION_ERROR_PX
    return np.where((close & _unfold(points, camera))[:, None], points, np.nan)


def _distort(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Pixels [M, 2] where ``radtan`` sees the points, and their derivative [M, 2, 2]."""
    import cv2

    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    zero, coefficients = np.zeros(3), camera.coefficients
    pixels, J = cv2.projectPoints(rays, zero, zero, camera.K, coefficients)
    # With the identity as pose, moving the camera by (tx, ty) moves the point by as much.
    derivative = np.nan_to_num(np.asarray(J[:, 3:5], dtype=np.float64)).reshape(-1, 2, 2)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), derivative


def _unfold(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> npt.NDArray[np.bool_]:
    """[M] True where the way from the centre to the point never turns back in the picture."""
    unfolded = np.ones(len(points), dtype=bool)
    for share in np.linspace(0.05, 1.0, 20):
        unfolded &= np.linalg.det(_distort(share * points, camera)[1]) > 0.0
    return unfolded
