"""The three residuals of a pose against a keyframe's pointmap (paper, Eq. 3).

All are whitened: one unit is one standard deviation. Derivatives are of the left tangent
``[translation, rotation]``, with ``log-scale`` as seventh where the scale is free. Arrays are
kept one row per coordinate, the matches along the last axis: that is what makes them cheap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import PoseResidual
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.float64]

BEHIND = 10.0
"""Whitened residual of a point behind the camera: a bad match, without a gradient."""
MIN_DEPTH_SHARE = 1e-3
"""Of the median depth; a nearer point counts as behind the camera."""
MIN_SIGMA = 1e-6
"""Relative; no range of a frame is more precise than float32."""
MAX_DEPTH_CHANGE = 0.5
"""Relative; further from the measured inverse depth the projection is no longer linear in it."""
INLIER = 3.0
"""Whitened residual up to which a match counts as an inlier."""


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
    frame_points: Array | None = None
    """[M, 3] the same points as the frame alone knows them, its camera frame; NaN where unknown."""
    frame_rho_variance: Array | None = None
    """[M] variance of their inverse depths in the frame."""
    around_rho: Array | None = None
    """[M] inverse depth around the points in the keyframe, without their own errors; derivatives
    are taken there."""


@dataclass(frozen=True)
class Rows:
    """A linearised residual of K rows a match."""

    residual: Array
    """[K, M]"""
    J: Array
    """[6 or 7, K, M]"""


class Matches:
    """The usable matches of a problem, one contiguous row per coordinate."""

    def __init__(self, problem: PoseProblem, residual: PoseResidual, free_scale: bool) -> None:
        if residual == "point" and problem.frame_points is None:
            raise ValueError("the point residual needs the frame's own points")
        around = problem.around_rho
        nearer = np.zeros(len(problem.points)) if around is None else around * problem.points[:, 2]
        columns = np.vstack(
            [problem.points.T, problem.rho_variance, problem.pixels.T, problem.weights, nearer]
        )
        own = _Own.of(problem)
        usable = np.asarray(np.isfinite(columns).all(0))
        if residual == "point" and own is not None:
            usable &= own.known
        if not usable.all():
            columns, own = columns[:, usable], None if own is None else own.at(usable)
        self.camera, self.sigma_px, self.size = problem.camera, problem.sigma_px, 6 + free_scale
        self.X, self.variance = columns[:3], columns[3]
        self.u, self.v, self.weights = columns[4], columns[5], columns[6]
        self.median_depth = float(np.median(self.X[2])) if self.X.size else 1.0
        """In the keyframe."""
        self.nearer = None if around is None else columns[7]
        """[M] inverse depth around a point over its own."""
        # Relative variance of the range; of the keyframe's points and of the frame's own.
        self.range_variance = self.variance * self.X[2] ** 2
        self.has_own = own is not None and bool(own.known.any())
        if own is not None:
            self.own = np.where(own.known, own.points, 1.0)
            self.own_range = np.sqrt((self.own**2).sum(0))
            relative = np.maximum(own.variance * self.own[2] ** 2, MIN_SIGMA**2)
            self.own_range_variance = np.where(own.known, relative, np.inf)

    def __len__(self) -> int:
        return int(self.X.shape[1])

    def rows(self, count: int) -> Rows:
        """Zeros to be filled."""
        return Rows(np.zeros((count, len(self))), np.zeros((self.size, count, len(self))))


@dataclass(frozen=True)
class _Own:
    """The points as the frame alone knows them; NaN where it does not."""

    points: Array
    """[3, M]"""
    variance: Array
    """[M] of their inverse depths."""

    @staticmethod
    def of(problem: PoseProblem) -> _Own | None:
        points, variance = problem.frame_points, problem.frame_rho_variance
        if points is None:
            return None
        return _Own(points.T, np.zeros(len(points)) if variance is None else variance)

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        finite = np.isfinite(self.points).all(0) & np.isfinite(self.variance)
        return np.asarray(finite & (self.points[2] > 0.0))

    def at(
        self,
        which: npt.NDArray[np.bool_],  # [M]
    ) -> _Own:
        return _Own(self.points[:, which], self.variance[which])


def point_rows(matches: Matches, T: Sim3) -> Rows:
    """The paper's: the keyframe's point, moved, against the frame's own; over sigma(range)."""
    moved = T.scale * (T.R @ matches.X)
    Y = moved + T.t[:, None]
    spread = matches.range_variance * (moved**2).sum(0)
    angle = matches.sigma_px / matches.camera.fx
    own = (matches.own_range_variance + angle**2) * matches.own_range**2
    inverse = 1.0 / np.sqrt(spread + own)
    rows = matches.rows(3)
    rows.residual[:] = (Y - matches.own) * inverse
    scaled = Y * inverse
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows.J[i, i] = inverse
        # omega x Y
        rows.J[3 + j, i], rows.J[3 + k, i] = scaled[k], -scaled[j]
    if matches.size == 7:
        rows.J[6] = scaled
    return rows


def ray_rows(matches: Matches, T: Sim3) -> Rows:
    """Unit rays, and the logarithm of the range where the frame knows it; needs no pinhole.

    The sigma of a ray is the match's, plus what the keyframe's depth moves it by.
    """
    camera = matches.camera
    moved = T.scale * (T.R @ matches.X)
    Y = moved + T.t[:, None]
    inverse_range = 1.0 / np.maximum(np.sqrt((Y**2).sum(0)), 1e-12)
    n = Y * inverse_range
    m = np.vstack(
        [
            (matches.u - camera.cx) / camera.fx,
            (matches.v - camera.cy) / camera.fy,
            np.ones_like(Y[0]),
        ]
    )
    m /= np.sqrt((m**2).sum(0))
    sideways = moved - n * (n * moved).sum(0)
    spread = (sideways**2).sum(0) * inverse_range**2 * matches.range_variance
    inverse = 1.0 / np.sqrt((matches.sigma_px / camera.fx) ** 2 + spread)
    rows = matches.rows(4 if matches.has_own else 3)
    rows.residual[:3] = (n - m) * inverse
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # dn / dY = (1 - n n') / |Y|
        rows.J[:3, i] = n * (-n[i] * inverse * inverse_range)
        rows.J[i, i] += inverse * inverse_range
        rows.J[3 + j, i], rows.J[3 + k, i] = n[k] * inverse, -n[j] * inverse
    if matches.has_own:
        sigma = np.sqrt(matches.range_variance + matches.own_range_variance)
        rows.residual[3] = -np.log(inverse_range * matches.own_range) / sigma
        rows.J[:3, 3], rows.J[6:, 3] = n * (inverse_range / sigma), 1.0 / sigma
    return rows


def pixel_rows(matches: Matches, T: Sim3) -> Rows:
    """Calibrated: along and across the epipolar line, then the log range where it is known.

    An error of the keyframe's inverse depth rho moves the projection along the epipolar line alone.
    rho is eliminated: the residual is what is left at its best value. Derivatives taken at the
    measured rho would share its noise with the residual, and the translation would shrink by the
    relative variance of rho at every frame (errors in variables). They are taken at the inverse
    depth around the point, or, where that is not known, at the best value: as good if the variances
    of rho and match are true, while a ratio of the two that is wrong by half leaves half the bias.
    """
    camera, z, variance = matches.camera, matches.X[2], matches.variance
    moved = T.scale * (T.R @ matches.X)
    Y = moved + T.t[:, None]
    nearest = nearest_depth(matches, T)
    behind = Y[2] < nearest
    iz = 1.0 / np.where(behind, 1.0, Y[2])
    x, y = Y[0] * iz, Y[1] * iz
    error_u = camera.fx * x + (camera.cx - matches.u)
    error_v = camera.fy * y + (camera.cy - matches.v)

    along_u, along_v, spread = _epipolar(camera, T, x, y, iz * z)
    along = along_u * error_u + along_v * error_v
    precision = 1.0 / (matches.sigma_px**2 + variance * spread * spread)
    inverse_along, inverse_across = np.sqrt(precision), 1.0 / matches.sigma_px

    rows = matches.rows(3 if matches.has_own else 2)
    rows.residual[0] = along * inverse_along
    rows.residual[1] = (along_u * error_v - along_v * error_u) * inverse_across
    change = -variance * spread * along * precision
    if matches.has_own:
        squared = (Y * Y).sum(0)
        lever = -z * (Y * moved).sum(0) / squared
        coupling = variance * lever * spread * precision
        left = variance * matches.sigma_px**2 * precision
        inverse_range = 1.0 / np.sqrt(matches.own_range_variance + lever * lever * left)
        log_ratio = 0.5 * np.log(squared / matches.own_range**2)
        rows.residual[2] = (log_ratio - coupling * along) * inverse_range
        change -= left * lever * rows.residual[2] * inverse_range

    change = _depth_change(matches, z * change, rows)
    best = moved / (1.0 + change) + T.t[:, None]
    iz = 1.0 / np.maximum(best[2], nearest)
    x, y = best[0] * iz, best[1] * iz
    to_along = (camera.fx * along_u * inverse_along, camera.fy * along_v * inverse_along)
    to_across = (-camera.fx * along_v * inverse_across, camera.fy * along_u * inverse_across)
    _image_row(rows.J[:, 0], *to_along, x, y, iz)
    _image_row(rows.J[:, 1], *to_across, x, y, iz)
    if matches.has_own:
        direction = best / (best * best).sum(0)
        rows.J[:3, 2] = direction * inverse_range
        rows.J[6:, 2] = inverse_range
        rows.J[:, 2] -= rows.J[:, 0] * (coupling * inverse_range / inverse_along)
    if behind.any():
        rows.residual[:, behind], rows.J[:, :, behind] = BEHIND, 0.0
    return rows


def nearest_depth(matches: Matches, T: Sim3) -> float:
    """Depth in the frame below which a point counts as behind the camera."""
    return MIN_DEPTH_SHARE * max(T.scale * matches.median_depth, 1e-12)


def _depth_change(
    matches: Matches,
    to_best: Array,  # [M]
    rows: Rows,
) -> Array:
    """[M] relative change of inverse depth to where the derivatives are taken."""
    if matches.nearer is not None:
        return np.asarray(matches.nearer - 1.0)
    to_best = np.clip(to_best, -MAX_DEPTH_CHANGE, MAX_DEPTH_CHANGE)
    # An outlier's residual says nothing about its depth.
    to_best[(np.abs(rows.residual) >= INLIER).any(0)] = 0.0
    return to_best


def _epipolar(
    camera: CameraModel,
    T: Sim3,
    x: Array,  # [M]
    y: Array,  # [M] image at z = 1
    lever: Array,  # [M] the point's depth in the keyframe over that in the frame
) -> tuple[Array, Array, Array]:
    """d pixel / d rho: its direction (u, v) and its length, [M] each.

    X = ray / rho, so dY / drho = -z (Y - t). A point with no parallax direction (length 0) takes
    the axes instead.
    """
    u = camera.fx * lever * (T.t[0] - x * T.t[2])
    v = camera.fy * lever * (T.t[1] - y * T.t[2])
    spread = np.sqrt(u * u + v * v)
    still = spread < 1e-12
    shorten = 1.0 / np.where(still, 1.0, spread)
    return np.where(still, 1.0, u * shorten), v * shorten, spread


def _image_row(
    J: Array,  # [6 or 7, M], written to
    p: Array,  # [M]
    q: Array,  # [M]
    x: Array,  # [M]
    y: Array,  # [M]
    iz: Array,  # [M] 1 / depth
) -> None:
    """Derivative [6 or 7, M] of p x + q y for p, q held; x and y are the point's image at z = 1.

    The projection does not change when everything grows: the scale's row stays zero.
    """
    r = -(p * x + q * y)
    J[0], J[1], J[2] = p * iz, q * iz, r * iz
    J[3], J[4], J[5] = y * r - q, p - x * r, x * q - y * p


ROWS: dict[PoseResidual, Callable[[Matches, Sim3], Rows]] = {
    "point": point_rows,
    "ray": ray_rows,
    "pixel": pixel_rows,
}
"""The function that makes the equations of each kind of residual."""
