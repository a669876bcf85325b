"""Pose of a frame against a keyframe's pointmap: least squares (paper, Eq. 3).

Scale is held at 1 inside a keyframe, because a free scale shrinks at every link
(notes/2026-11-tracking.md#pose-solver); between keyframes it may be freed.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import PoseResidual
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.optimise.least_squares import Ending, NormalEquations, Rules, minimise
from aquaflow.optimise.robust import Huber
from aquaflow.render.library import Library, library_or_none
from aquaflow.tracking.pose.residuals import (
    BEHIND,
    MAX_DEPTH_CHANGE,
    ROWS,
    Matches,
    PoseProblem,
    Rows,
    nearest_depth,
)

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
        """Cost of the weighted, whitened Huber loss."""
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


# --------------------------------------------------------------------------------------------------
# Uncertainty of a solved pose: covariance and degeneracy from its normal equations.
#
# Translation is counted in median depths here, so that it and rotation are both angles.

Direction = Literal["translation", "rotation", "scale"]

UNKNOWN_SIGMA = 1e3
"""Standard deviation, in median depths or radians, of a direction without information."""
ROUNDING = 1e-13
"""Share of the largest eigenvalue below which another is float64 noise, not information."""
CELLS_ACROSS = 8
"""Cells over the picture's width; the errors of matches in one cell count as one draw. Measured on
the reef clip, two poses from two halves of each frame's matches, squared distance in their stated
covariance (5.3 is honest): halves of opposite quarters 314 without cells, 61 with 24 cells across,
21 with 12, 11 with 8; halves of a fine chequerboard 57, 7, 2.3 and 1.6. What all matches of a
picture share (calibration, the keyframe's depths) no frame can see by itself."""


@dataclass(frozen=True)
class Degeneracy:
    """The eigenvalues of the normal equations, read out."""

    eigenvalues: Array
    """[n] ascending, rad^-2: the information along each principal direction."""
    weakest: Array
    """[n] unit tangent of the first: [translation in median depths, rotation, log-scale]."""
    kind: Direction
    """What ``weakest`` mostly is."""
    weakest_sigma: float
    """Standard deviation along it, rad or median depths; at most UNKNOWN_SIGMA."""
    baseline_sigmas: float
    """The translation over its own standard deviation. Below about 4 there may be none: a pure
    rotation, or a scene at infinity; nothing can be triangulated from such a frame."""

    @property
    def conditioning(self) -> float:
        """Smallest over largest eigenvalue: 0 when a direction is free."""
        return float(self.eigenvalues[0] / max(self.eigenvalues[-1], 1e-300))


def pose_covariance(
    H: Array,  # [n, n]
    scores: Array,  # [n, C], sum of weighted J' r in each cell of the picture
    T: Sim3,
    depth: float,
) -> tuple[Array, Degeneracy]:
    """Covariance [n, n] of the left tangent, and the degeneracy report.

    The covariance is the inverse of H, grown by how much more the scores vary from cell to cell
    than independent matches of the stated noise would make them: neighbouring matches err
    together, and five thousand of them are worth as few as the measured variance says
    (cluster-robust variance: Liang and Zeger, Biometrika 1986; as one factor for all directions,
    because a few dozen cells give no better estimate). It never shrinks below what the noise
    allows.
    """
    unit = np.ones(len(H))
    unit[:3] = depth
    values, vectors = np.linalg.eigh(H * unit[:, None] * unit[None, :])
    values = np.where(values > ROUNDING * max(values[-1], 0.0), values, 0.0)
    inflation = _inflation(values, vectors.T @ (scores * unit[:, None]))
    sigma = np.minimum(np.sqrt(inflation / np.maximum(values, 1e-300)), UNKNOWN_SIGMA)
    spread = vectors * sigma * unit[:, None]
    covariance = spread @ spread.T
    weakest = vectors[:, 0]
    parts = [np.linalg.norm(weakest[i : i + 3]) for i in (0, 3, 6)]
    kind: Direction = ("translation", "rotation", "scale")[int(np.argmax(parts))]
    baseline = float(np.sqrt(T.t @ np.linalg.solve(covariance[:3, :3], T.t)))
    return covariance, Degeneracy(values, weakest, kind, float(sigma[0]), baseline)


def _inflation(
    values: Array,  # [n]
    scores: Array,  # [n, C] along the eigenvectors
) -> float:
    known = values > 0.0
    if not known.any():
        return 1.0
    return max(1.0, float(((scores[known] ** 2).sum(1) / values[known]).mean()))


def cell_sums(
    scores: Array,  # [n, M]
    u: Array,  # [M] px
    v: Array,  # [M] px
    width: int,
    height: int,
) -> Array:
    """[n, C] sums of ``scores`` over square cells of the picture."""
    size = width / CELLS_ACROSS
    down = int(np.ceil(height / size))
    column = np.clip(u / size, 0, CELLS_ACROSS - 1).astype(np.intp)
    row = np.clip(v / size, 0, down - 1).astype(np.intp)
    cell = row * CELLS_ACROSS + column
    return np.stack([np.bincount(cell, each, down * CELLS_ACROSS) for each in scores])


# --------------------------------------------------------------------------------------------------
# Cost and normal equations by the pixel residual in compiled code (native/pose_equations.h).

_COLUMNS = ("X", "Y", "Z", "variance", "u", "v", "weights", "nearer")


class _Equations(ctypes.Structure):
    """``PoseEquations`` of native/pose_equations.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in _COLUMNS),
        ("count", ctypes.c_int32),
        *((name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy", "sigma_px")),
        ("R", ctypes.c_double * 9),
        ("t", ctypes.c_double * 3),
        ("scale", ctypes.c_double),
        *(
            (name, ctypes.c_double)
            for name in ("nearest", "huber", "behind", "most_change", "inlier")
        ),
    )


class _Result(ctypes.Structure):
    """``PoseResult`` of the same file."""

    _fields_ = (
        ("H", ctypes.c_double * 36),
        ("g", ctypes.c_double * 6),
        ("cost", ctypes.c_double),
    )


class _Left(ctypes.Structure):
    """``PoseLeft`` of the same file."""

    _fields_ = (("residual", ctypes.c_void_p), ("pull", ctypes.c_void_p))


class PixelEquations:
    """The compiled equations of some matches, at one pose after the other."""

    def __init__(self, library: Library, matches: Matches, huber: float) -> None:
        self._library, self._matches = library, matches
        self._columns = [
            None if each is None else np.ascontiguousarray(each, np.float64)
            for each in (
                *matches.X, matches.variance, matches.u, matches.v, matches.weights, matches.nearer
            )
        ]  # fmt: skip
        addresses = [None if each is None else each.ctypes.data for each in self._columns]
        limits = {"behind": BEHIND, "most_change": MAX_DEPTH_CHANGE, "inlier": INLIER}
        columns = dict(zip(_COLUMNS, addresses, strict=True))
        self._given = given = _Equations(**columns, **limits)
        camera = matches.camera
        given.fx, given.fy, given.cx, given.cy = camera.fx, camera.fy, camera.cx, camera.cy
        given.count, given.sigma_px, given.huber = len(matches), matches.sigma_px, huber

    def at(self, T: Sim3) -> tuple[Array, Array, float]:
        """H [6, 6], g [6] and cost of the weighted Huber loss at ``T``."""
        return self._evaluate(T, None)

    def residuals_and_pulls(self, T: Sim3) -> tuple[Array, Array]:
        """Residuals [2, M] at ``T``, and what each match pulls by [6, M]: weighted J' residual."""
        count = len(self._matches)
        residual, pull = np.empty((2, count)), np.empty((6, count))
        self._evaluate(T, _Left(residual.ctypes.data, pull.ctypes.data))
        return residual, pull

    def _evaluate(self, T: Sim3, left: _Left | None) -> tuple[Array, Array, float]:
        given, result = self._given, _Result()
        given.R[:], given.t[:], given.scale = T.R.reshape(-1).tolist(), T.t.tolist(), T.scale
        given.nearest = nearest_depth(self._matches, T)
        out = None if left is None else ctypes.byref(left)
        self._library.call("aq_pose_equations", ctypes.byref(given), ctypes.byref(result), out)
        H = np.array(result.H, dtype=np.float64).reshape(6, 6)
        return H, np.array(result.g, dtype=np.float64), float(result.cost)
