"""Pose of a frame against a keyframe's pointmap: calibrated Gauss-Newton (paper, Eq. pose_opt).

The residual is the ``pixel`` one: the keyframe's point, moved into the frame, against its match.
Scale is held at 1 inside a keyframe, because the paper's free scale shrinks at every link
(prior_notes.md section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, hat, so3_exp

Array = npt.NDArray[np.float64]

HUBER = 1.345
"""Whitened residual where the loss turns linear: 95 % efficiency under Gaussian noise."""
INLIER = 3.0
"""Whitened residual up to which a match counts as an inlier."""
MAX_ITERATIONS = 15
STOP_STEP = 1e-7
STOP_RELATIVE_DECREASE = 1e-6
FIRST_DAMPING = 1e-6
MAX_DAMPING = 1e6


@dataclass(frozen=True)
class PoseEstimate:
    """The pose that minimises the whitened Huber loss, and how well it is known."""

    T: Sim3
    """T_fk: keyframe to frame."""
    covariance: Array
    """[6, 6] of the left tangent [translation, rotation]."""
    inlier_share: float
    residual_px: float
    """Median reprojection error."""
    conditioning: float
    """Smallest over largest eigenvalue of the scaled normal matrix: 0 for degenerate motion."""


@dataclass(frozen=True)
class PoseProblem:
    """Matches of one frame with points of one keyframe."""

    points: Array
    """[M, 3] keyframe camera frame."""
    rho_variance: Array
    """[M] variance of the points' inverse depths in the keyframe."""
    pixels: Array
    """[M, 2] px, where the points are seen in the frame."""
    weights: Array
    """[M] match confidence in [0, 1]."""
    camera: CameraModel
    sigma_px: float


def solve_pose(
    problem: PoseProblem, initial: Sim3, stop_converged: bool = True
) -> PoseEstimate | None:
    """Levenberg-Marquardt from ``initial``; None without matches, or when the normal equations stay
    unsolvable. Without ``stop_converged`` it takes all MAX_ITERATIONS."""
    if len(problem.points) == 0:
        return None
    T, damping = initial, FIRST_DAMPING
    residual, J = _linearise(problem, T)
    cost = _cost(residual, problem.weights)
    for _ in range(MAX_ITERATIONS):
        H, g = _normal_equations(residual, J, problem.weights)
        step = _damped_step(H, g, damping)
        if step is None:
            return None
        candidate = Sim3(so3_exp(step[3:]) @ T.R, so3_exp(step[3:]) @ T.t + step[:3])
        new_residual, new_J = _linearise(problem, candidate)
        new_cost = _cost(new_residual, problem.weights)
        if not np.isfinite(new_cost) or new_cost > cost:
            damping *= 10.0
            if damping > MAX_DAMPING:
                break
            continue
        decrease = (cost - new_cost) / max(cost, 1e-12)
        T, residual, J, cost = candidate, new_residual, new_J, new_cost
        damping = max(damping * 0.1, 1e-9)
        still = decrease < STOP_RELATIVE_DECREASE or float(np.linalg.norm(step)) < STOP_STEP
        if still and stop_converged:
            break
    return _summary(problem, T, residual, J)


def _linearise(problem: PoseProblem, T: Sim3) -> tuple[Array, Array]:
    """Whitened residuals [M, 2] and Jacobians [M, 2, 6] (left tangent).

    An error of the keyframe's inverse depth moves the projection along one direction, the epipolar
    one: there the residual is divided by the larger sigma, across it by the matching noise alone.
    """
    camera = problem.camera
    rotated = problem.points @ T.R.T
    Y = rotated + T.t
    inverse_z = 1.0 / np.maximum(Y[:, 2], 1e-6)
    x, y = Y[:, 0] * inverse_z, Y[:, 1] * inverse_z
    error = np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1) - problem.pixels

    projection = np.zeros((len(Y), 2, 3))
    projection[:, 0, 0] = camera.fx * inverse_z
    projection[:, 0, 2] = -camera.fx * x * inverse_z
    projection[:, 1, 1] = camera.fy * inverse_z
    projection[:, 1, 2] = -camera.fy * y * inverse_z

    # X = ray / rho  =>  dX/drho = -X / rho = -X z, and z = X_z of the keyframe's point.
    depth = problem.points[:, 2]
    along = np.einsum("nij,nj->ni", projection, -rotated * depth[:, None])
    spread = np.linalg.norm(along, axis=1)
    e = along / np.maximum(spread, 1e-12)[:, None]
    sigma_along = np.sqrt(problem.sigma_px**2 + problem.rho_variance * spread**2)
    rows = np.stack(
        [e / sigma_along[:, None], np.stack([-e[:, 1], e[:, 0]], -1) / problem.sigma_px], axis=1
    )
    # A point with no parallax direction (spread 0) has both rows zero: use the axes instead.
    still = spread < 1e-12
    rows[still] = np.eye(2) / problem.sigma_px
    residual = np.einsum("nij,nj->ni", rows, error)
    dY = np.concatenate([np.broadcast_to(np.eye(3), (len(Y), 3, 3)), -hat(Y)], axis=2)
    return residual, rows @ projection @ dY


def _huber_weights(residual: Array) -> Array:
    size = np.abs(residual)
    return np.where(size <= HUBER, 1.0, HUBER / np.maximum(size, 1e-12))


def _cost(residual: Array, weights: Array) -> float:
    size = np.abs(residual)
    loss = np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER))
    return float((loss.sum(1) * weights).sum())


def _normal_equations(residual: Array, J: Array, weights: Array) -> tuple[Array, Array]:
    w = _huber_weights(residual) * weights[:, None]
    flat = J.reshape(-1, 6)
    weighted = flat * w.reshape(-1, 1)
    return weighted.T @ flat, weighted.T @ residual.reshape(-1)


def _damped_step(H: Array, g: Array, damping: float) -> Array | None:
    """-(H + damping diag H)^-1 g by Cholesky, with more damping until it succeeds."""
    diagonal = np.maximum(np.diag(H), 1e-12 * max(float(np.diag(H).max()), 1e-12))
    while damping <= MAX_DAMPING:
        try:
            L = np.linalg.cholesky(H + damping * np.diag(diagonal))
        except np.linalg.LinAlgError:
            damping *= 10.0
            continue
        step = -np.linalg.solve(L.T, np.linalg.solve(L, g))
        return step if np.isfinite(step).all() else None
    return None


def _summary(problem: PoseProblem, T: Sim3, residual: Array, J: Array) -> PoseEstimate | None:
    H, _ = _normal_equations(residual, J, problem.weights)
    if not (np.isfinite(H).all() and T.is_finite()):
        return None
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    eigenvalues = np.linalg.eigvalsh(H * scale[:, None] * scale[None, :])
    conditioning = float(max(eigenvalues[0], 0.0) / max(eigenvalues[-1], 1e-12))
    covariance = np.linalg.pinv(H, hermitian=True).astype(np.float64, copy=False)
    Y = T.apply(problem.points)
    in_front = Y[:, 2] > 1e-3
    error = np.linalg.norm(problem.camera.project(Y) - problem.pixels, axis=1)
    inlier = in_front & (np.abs(residual) < INLIER).all(1)
    residual_px = float(np.median(error[inlier])) if inlier.any() else float("inf")
    return PoseEstimate(T, covariance, float(inlier.mean()), residual_px, conditioning)
