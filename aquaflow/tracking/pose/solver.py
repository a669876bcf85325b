"""Pose of a frame against a keyframe's pointmap: Levenberg-Marquardt (paper, Eq. 3).

Scale is held at 1 inside a keyframe, because a free scale shrinks at every link
(notes/measurements.md#pose-solver); between keyframes it may be freed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import PoseResidual
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.render.library import library_or_none
from aquaflow.tracking.pose.covariance import Degeneracy, cell_sums, pose_covariance
from aquaflow.tracking.pose.pixel_equations import PixelEquations
from aquaflow.tracking.pose.residuals import ROWS, Matches, PoseProblem, Rows

__all__ = ["PoseEstimate", "PoseProblem", "solve_pose"]

Array = npt.NDArray[np.float64]

HUBER = 1.345
"""Whitened residual where the loss turns linear: 95 % efficiency under Gaussian noise."""
INLIER = 3.0
"""Whitened residual up to which a match counts as an inlier."""
MAX_ITERATIONS = 15
"""Limit of Levenberg-Marquardt for one pose."""
STOP_SIGMAS = 0.1
"""A step of this many of the pose's own standard deviations is the last. Steps shrink at least
threefold, also with a third of outliers: the remaining error is a twentieth of the noise."""
SLACK = 1e-2
"""Relative growth of the cost that refuses no step. The whitening depends on the pose, and outliers
gain from a pose that is less certain; the scores leave that out, so near the solution the cost
does not follow them."""
FIRST_DAMPING = 1e-6
"""Initial damping, relative to the diagonal."""
MAX_DAMPING = 1e6
"""Damping at which the solver stops: no step reduces the cost."""


@dataclass(frozen=True)
class PoseEstimate:
    """The pose that minimises the whitened Huber loss, and its covariance."""

    T: Sim3
    """T_fk: keyframe to frame."""
    covariance: Array
    """[6, 6] of the left tangent [translation, rotation]; [7, 7] with log-scale if that is free.
    Huge, never singular, along a direction without information from the matches."""
    inlier_share: float
    residual_px: float
    """Median reprojection error."""
    conditioning: float
    """Smallest over largest eigenvalue, translation in median depths: 0 for degenerate motion."""
    degeneracy: Degeneracy


def solve_pose(
    problem: PoseProblem,
    initial: Sim3,
    stop_converged: bool = True,
    residual: PoseResidual = "pixel",
    free_scale: bool = False,
) -> PoseEstimate | None:
    """Levenberg-Marquardt from ``initial``; None without matches, or when the normal equations stay
    unsolvable. Without ``stop_converged`` it takes all MAX_ITERATIONS.

    A match that is no number is left out. With ``free_scale`` the pose is a similarity; the
    ``pixel`` and ``ray`` residuals see its scale only through the frame's own points. Without, its
    scale is 1, whatever that of ``initial`` is: poses of the graph have one, and a motion
    that was extrapolated with it would grow with every frame.

    Raises:
        ValueError: ``point`` is asked for and the problem has no points of the frame's own.
    """
    matches = Matches(problem, residual, free_scale)
    if len(matches) == 0 or not initial.is_finite():
        return None
    equations = _equations(matches, residual)
    T, damping = initial if free_scale else initial.in_source_unit(), FIRST_DAMPING
    H, g, cost = equations.at(T)
    for _ in range(MAX_ITERATIONS):
        step = _damped_step(H, g, damping)
        if step is None:
            return None
        candidate = _move(T, step)
        new_H, new_g, new_cost = equations.at(candidate)
        still = stop_converged and float(step @ H @ step) < STOP_SIGMAS**2
        if not np.isfinite(new_cost) or new_cost > cost * (1.0 + SLACK):
            damping *= 10.0
            if still or damping > MAX_DAMPING:
                break
            continue
        T, H, g, cost = candidate, new_H, new_g, new_cost
        damping = max(damping * 0.1, 1e-9)
        if still:
            break
    return _summary(problem, matches, T, H, *equations.linearise_at(T))


class RowEquations:
    """The equations of some matches from their rows: readable, for every kind of residual."""

    def __init__(self, matches: Matches, residual: PoseResidual) -> None:
        self._matches, self._linearise = matches, ROWS[residual]

    def at(self, T: Sim3) -> tuple[Array, Array, float]:
        """H [n, n], g [n] and cost of the weighted Huber loss at ``T``."""
        rows, weights = self._linearise(self._matches, T), self._matches.weights
        return *_normal_equations(rows, weights), _cost(rows.residual, weights)

    def linearise_at(self, T: Sim3) -> tuple[Array, Array]:
        """Residuals [K, M] at ``T``, and what each match pulls by [n, M]: weighted J' residual."""
        rows = self._linearise(self._matches, T)
        pull = _huber_weights(rows.residual) * rows.residual * self._matches.weights
        return rows.residual, np.asarray((rows.J * pull).sum(1))


def _equations(matches: Matches, residual: PoseResidual) -> RowEquations | PixelEquations:
    """Compiled, where that can be had: a third of the time, for pixels without own ranges."""
    library = library_or_none()
    if library is None or residual != "pixel" or matches.size != 6 or matches.has_own:
        return RowEquations(matches, residual)
    return PixelEquations(library, matches, HUBER)


def _move(
    T: Sim3,
    step: Array,  # [6 or 7]
) -> Sim3:
    """First-order retraction of the left tangent."""
    R = so3_exp(step[3:6])
    growth = float(np.exp(step[6])) if len(step) == 7 else 1.0
    return Sim3(R @ T.R, growth * (R @ T.t) + step[:3], growth * T.scale)


def _huber_weights(
    residual: Array,  # [R, M], R residuals of each match
) -> Array:
    return HUBER / np.maximum(np.abs(residual), HUBER)


def _cost(
    residual: Array,  # [R, M], R residuals of each match
    weights: Array,  # [M]
) -> float:
    size = np.abs(residual)
    near = np.minimum(size, HUBER)
    # Half the square up to HUBER, the tangent from there on.
    return float(((size - 0.5 * near) * near).sum(0) @ weights)


def _normal_equations(
    rows: Rows,
    weights: Array,  # [M]
) -> tuple[Array, Array]:
    root = np.sqrt(_huber_weights(rows.residual) * weights)
    J = (rows.J * root).reshape(len(rows.J), -1)
    return J @ J.T, J @ (rows.residual * root).reshape(-1)


def _damped_step(
    H: Array,  # [n, n]
    g: Array,  # [n]
    damping: float,
) -> Array | None:
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


def _summary(
    problem: PoseProblem,
    matches: Matches,
    T: Sim3,
    H: Array,  # [n, n]
    residual: Array,  # [K, M]
    pull: Array,  # [n, M]
) -> PoseEstimate | None:
    if not (np.isfinite(H).all() and T.is_finite()):
        return None
    Y = T.scale * (T.R @ matches.X) + T.t[:, None]
    in_front = Y[2] > 0.0
    depth = float(np.median(Y[2][in_front])) if in_front.any() else 1.0
    camera = matches.camera
    cells = cell_sums(pull, matches.u, matches.v, camera.width, camera.height)
    covariance, degeneracy = pose_covariance(H, cells, T, depth)

    inlier = in_front & (np.abs(residual) < INLIER).all(0)
    residual_px = float("inf")
    if inlier.any():
        seen = camera.project(Y[:, inlier].T)
        error_u, error_v = seen[:, 0] - matches.u[inlier], seen[:, 1] - matches.v[inlier]
        residual_px = float(np.median(np.hypot(error_u, error_v)))
    share = float(inlier.sum()) / len(problem.points)
    return PoseEstimate(T, covariance, share, residual_px, degeneracy.conditioning, degeneracy)
