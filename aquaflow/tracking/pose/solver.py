"""Pose of a frame against a keyframe's pointmap: least squares (paper, Eq. 3).

Scale is held at 1 inside a keyframe, because a free scale shrinks at every link
(notes/2026-11-tracking.md#pose-solver); between keyframes it may be freed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import PoseResidual
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.optimise.least_squares import Ending, NormalEquations, Rules, minimise
from aquaflow.optimise.robust import Huber
from aquaflow.render.library import library_or_none
from aquaflow.tracking.pose.covariance import Degeneracy, cell_sums, pose_covariance
from aquaflow.tracking.pose.pixel_equations import PixelEquations
from aquaflow.tracking.pose.residuals import ROWS, Matches, PoseProblem, Rows

__all__ = ["PoseEstimate", "PoseProblem", "solve_pose"]

Array = npt.NDArray[np.float64]

KERNEL = Huber()
"""Of whitened residuals."""
INLIER = 3.0
"""Whitened residual up to which a match counts as an inlier."""
RULES = Rules(iterations=15, sigmas=0.1, slack=1e-2, damping=1e-6)
"""Steps shrink at least threefold, also with a third of outliers: after one of a tenth of the
pose's own standard deviation the remaining error is a twentieth of the noise. Growth of the cost by
a hundredth refuses no step: the whitening depends on the pose, and outliers gain from a pose that
is less certain; the scores leave that out, so near the solution the cost does not follow them."""


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
    unsolvable. Without ``stop_converged`` it takes all iterations.

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
    start = initial if free_scale else initial.in_source_unit()
    rules = RULES if stop_converged else replace(RULES, sigmas=0.0)
    descent = _PoseDescent(equations)
    found = minimise(descent, start, rules)
    if found.ending in {Ending.SINGULAR, Ending.NOT_FINITE}:
        return None
    H = descent.linearise(found.state).H
    return _summary(
        len(problem.points), matches, found.state, H, *equations.residuals_and_pulls(found.state)
    )


class _PoseDescent:
    """A pose as a problem of least squares; cost and equations come in one evaluation."""

    def __init__(self, equations: RowEquations | PixelEquations) -> None:
        self._equations = equations
        self._last: tuple[Sim3, NormalEquations] | None = None

    def linearise(self, T: Sim3) -> NormalEquations:
        """The equations of a step [6 or 7] of the left tangent."""
        if self._last is None or self._last[0] is not T:
            self._last = T, NormalEquations(*self._equations.at(T))
        return self._last[1]

    def cost(self, T: Sim3) -> float:
        """Of the weighted, whitened Huber loss."""
        return self.linearise(T).cost

    def move(
        self,
        T: Sim3,
        step: Array,  # [P]
    ) -> Sim3:
        """First-order retraction of the left tangent."""
        R = so3_exp(step[3:6])
        growth = float(np.exp(step[6])) if len(step) == 7 else 1.0
        return Sim3(R @ T.R, growth * (R @ T.t) + step[:3], growth * T.scale)


class RowEquations:
    """The equations of some matches from their rows: readable, for every kind of residual."""

    def __init__(self, matches: Matches, residual: PoseResidual) -> None:
        self._matches, self._linearise = matches, ROWS[residual]

    def at(self, T: Sim3) -> tuple[Array, Array, float]:
        """H [n, n], g [n] and cost of the weighted Huber loss at ``T``."""
        rows, weights = self._linearise(self._matches, T), self._matches.weights
        cost = float(KERNEL.cost(np.abs(rows.residual)).sum(0) @ weights)
        return *_normal_equations(rows, weights), cost

    def residuals_and_pulls(self, T: Sim3) -> tuple[Array, Array]:
        """Residuals [K, M] at ``T``, and what each match pulls by [n, M]: weighted J' residual."""
        rows = self._linearise(self._matches, T)
        pull = KERNEL.weight(np.abs(rows.residual)) * rows.residual * self._matches.weights
        return rows.residual, np.asarray((rows.J * pull).sum(1))


def _equations(matches: Matches, residual: PoseResidual) -> RowEquations | PixelEquations:
    """Compiled, where that can be had: a third of the time, for pixels without own ranges."""
    library = library_or_none()
    if library is None or residual != "pixel" or matches.size != 6 or matches.has_own:
        return RowEquations(matches, residual)
    return PixelEquations(library, matches, KERNEL.bound)


def _normal_equations(
    rows: Rows,
    weights: Array,  # [M]
) -> tuple[Array, Array]:
    root = np.sqrt(KERNEL.weight(np.abs(rows.residual)) * weights)
    J = (rows.J * root).reshape(len(rows.J), -1)
    return J @ J.T, J @ (rows.residual * root).reshape(-1)


def _summary(
    points: int,
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
    share = float(inlier.sum()) / points
    return PoseEstimate(T, covariance, share, residual_px, degeneracy.conditioning, degeneracy)
