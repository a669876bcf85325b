"""One frame against one keyframe: matches, pose, and whether both are reliable."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.prior.contract import Encoding, PairGeometry
from aquaflow.tracking.frames import Quality
from aquaflow.tracking.learned import learned_depth
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem, solve_pose

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


# --------------------------------------------------------------------------------------------------
# Inverse depth around every pixel of a pointmap, without the pixel's own error.
#
# Depths are known to a few percent, and what is multiplied or selected by them shares their noise:
# a translation solved with derivatives at noisy depths is too short by their relative variance
# (errors in variables), and of far points those that noise brought nearer pass a limit on the
# relative precision. The depths around a pixel have other errors. What is weighted and selected by
# them is unbiased, however well the variances of depths and matches are known (instrumental
# variables: Durbin, Review of the International Statistical Institute 1954).

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

CELL_PX = 4
"""Side of the cells that the mean is taken over; one value serves all pixels of a cell."""
OUTER_CELLS = 7
"""Side of the square around a cell that its mean is taken over."""
INNER_CELLS = 3
"""Side of the square around a cell that is left out: matches 4 px away or nearer share their
windows (prior/flow.py), and their errors."""
LEAST_CELLS = 2.5
"""Known part of the square, in cells, below which nothing is known around: 40 pixels."""


def surroundings(
    pointmap: Pointmap,
    relative_sigma: float,
) -> tuple[Float, Mask]:
    """Inverse depth around every pixel, [H, W]; and the pixels, [H, W], whose own is known to
    better than ``relative_sigma`` of that. Where nothing is known around, it is the pixel's own."""
    around = _mean_around(pointmap.rho.astype(np.float32), pointmap.is_known(relative_sigma))
    known = (pointmap.rho > 1e-6) & (pointmap.variance < (relative_sigma * around) ** 2)
    return around, known


def _mean_around(
    rho: Float,  # [H, W]
    known: Mask,  # [H, W]
) -> Float:
    import cv2

    height, width = rho.shape
    cells = (max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX)))
    mass = known.astype(np.float32)
    around = []
    for field in (mass, mass * rho):
        sums = cv2.resize(field, cells, interpolation=cv2.INTER_AREA)
        outer, inner = (
            cv2.boxFilter(sums, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
            for side in (OUTER_CELLS, INNER_CELLS)
        )
        around.append(outer - inner)
    count, total = around
    enough = count > LEAST_CELLS
    mean = np.where(enough, total / np.where(enough, count, 1.0), 0.0).astype(np.float32)
    everywhere = cv2.resize(mean, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(np.where(everywhere > 0.0, everywhere, rho), dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# What a frame should show of a keyframe, and how much of that was matched.
#
# Matches are lost for two reasons. Where the view has moved on, a new keyframe brings them back;
# where something hides the scene (marine snow, silt, fish, a flash) it does not, and a keyframe
# that shows flakes is worse than the clear one. The pose separates the two cases.

MAX_TURN = np.cos(np.radians(30.0))
"""Cosine of the angle between two rays to a point beyond which it need not look the same. Survey
pictures 20 degrees apart still match 98 % of what both show."""
MAX_ZOOM = 1.5
"""Ratio of two ranges of a point beyond which it need not look the same."""
POINTS = 4000
"""Points sampled: a share of 1 % is known to better than a tenth of it."""
AGREEMENT_WIDTHS = 3.0 / 480.0
"""Distance between a match and where the pose puts it, over width, up to which they agree; six
sigmas of a checked DIS match at 480 px."""


@dataclass(frozen=True)
class Visibility:
    """A keyframe's points in a frame."""

    overlap: float
    """Share of the keyframe's known points that the frame should show, by the pose alone."""
    seen: float
    """Of these, the share that was matched, and to where the pose puts it: what is missing is
    hidden. Large flakes remove matches, small ones displace them."""


def is_expected(
    points: Array,  # [M, 3] in the keyframe
    T_fk: Sim3,
    camera: CameraModel,
) -> Mask:
    """[M] points that a frame at ``T_fk`` shows as the keyframe does: in the picture, at a similar
    angle and range."""
    Y = T_fk.apply(points)
    pixels = camera.project(Y)
    inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(-1)
    # Y / scale: both ranges in the keyframe's unit.
    turned = points @ T_fk.R.T
    range_k, range_f = np.linalg.norm(turned, axis=1), np.linalg.norm(Y, axis=1)
    alike = (turned * Y).sum(1) > MAX_TURN * range_k * range_f
    zoom = range_f / np.maximum(T_fk.scale * range_k, 1e-12)
    alike &= (zoom < MAX_ZOOM) & (zoom > 1.0 / MAX_ZOOM)
    return np.asarray(inside & alike & (Y[:, 2] > 0.0))


def visibility(
    pointmap: Pointmap,
    looked_at: Mask,  # [H, W] pixels of the keyframe that a match is expected of
    matches: npt.NDArray[np.float32],  # [H, W, 2] px
    valid: Mask,  # [H, W] those that were matched
    T_fk: Sim3,
    camera: CameraModel,
) -> Visibility:
    """Visibility of the points of ``pointmap`` at ``looked_at`` pixels, all of known depth.

    Where the frame should show none of them, none of them is missing.
    """
    rows, columns, points = sample(pointmap, looked_at, POINTS)
    here = is_expected(points, T_fk, camera)
    if not here.any():
        return Visibility(0.0, 1.0)
    rows, columns, points = rows[here], columns[here], points[here]
    off = np.linalg.norm(camera.project(T_fk.apply(points)) - matches[rows, columns], axis=1)
    seen = valid[rows, columns] & (off < AGREEMENT_WIDTHS * camera.width)
    return Visibility(float(here.mean()), float(seen.mean()))


def evenly_taken(
    which: Mask,  # [H, W]
    count: int,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns, [M] each, of at most ``count`` of the pixels, evenly taken row by row."""
    # Of a picture in two dimensions NumPy looks for them ten times as long.
    pixels = np.flatnonzero(which)
    pixels = pixels[:: max(1, -(-len(pixels) // count))]
    rows, columns = np.divmod(pixels, which.shape[1])
    return rows, columns


def sample(
    pointmap: Pointmap,
    which: Mask,  # [H, W] pixels of known depth
    count: int,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Array]:
    """Rows, columns and points [M, 3] of at most ``count`` pixels, evenly taken."""
    rows, columns = evenly_taken(which, count)
    rays = pointmap.camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1))
    return rows, columns, rays / pointmap.rho[rows, columns, None]


def predicted_matches(
    pointmap: Pointmap,
    known: Mask,  # [H, W] pixels whose depth is valid
    T_fk: Sim3,
    camera: CameraModel,
    otherwise: npt.NDArray[np.float32],  # [H, W, 2] px
) -> npt.NDArray[np.float32]:
    """[H, W, 2] px where the pose puts the keyframe's pixels; ``otherwise`` where it cannot."""
    rows, columns, points = sample(pointmap, known, known.size)
    out = otherwise.copy()
    out[rows, columns] = camera.project(T_fk.apply(points))
    return out


def agreeing(
    pointmap: Pointmap,
    matches_back: npt.NDArray[np.float32],  # [H, W, 2] px, where each pixel of the frame lies
    valid_back: Mask,  # [H, W]
    T_fk: Sim3,
    camera: CameraModel,
) -> Mask:
    """[H, W] pixels of the frame that show the point that their match in the keyframe is."""
    rows, columns = np.nonzero(valid_back)
    source = matches_back[rows, columns].astype(np.float64)
    height, width = pointmap.rho.shape
    u = np.clip(np.floor(source[:, 0]).astype(np.intp), 0, width - 1)
    v = np.clip(np.floor(source[:, 1]).astype(np.intp), 0, height - 1)
    rho = pointmap.rho[v, u]
    rays = pointmap.camera.unproject(source)
    pixels = camera.project(T_fk.apply(rays / np.maximum(rho, 1e-12)[:, None]))
    off = np.linalg.norm(pixels - np.stack([columns + 0.5, rows + 0.5], -1), axis=1)
    good = (rho > 1e-6) & (off < AGREEMENT_WIDTHS * camera.width)
    out = np.zeros_like(valid_back)
    out[rows[good], columns[good]] = True
    return out


# --------------------------------------------------------------------------------------------------
# Where a keyframe's pixels are expected in the next frame, if its motion is known beforehand.

WIDE_WIDTHS = 0.04
"""Widths of the picture: flow follows smaller steps from the last matches as well, and DIS alone
loses those beyond 0.15 (``prior/flow_pair.py``)."""
GRID = 12
"""Pixels a side that are looked at to tell whether a step is wide."""


def is_wide(pointmap: Pointmap, T_before: Sim3, T_next: Sim3, camera: CameraModel) -> bool:
    """True if the pictures' shift from one pose of the frame to the other is wide."""
    height, width = pointmap.rho.shape
    points = _points(pointmap, max(1, height // GRID), max(1, width // GRID)).reshape(-1, 3)
    before, after = T_before.apply(points), T_next.apply(points)
    ahead = (before[:, 2] > 0.0) & (after[:, 2] > 0.0)
    if not ahead.any():
        return False
    shift = camera.project(after[ahead]) - camera.project(before[ahead])
    return bool(np.median(np.linalg.norm(shift, axis=1)) > WIDE_WIDTHS * camera.width)


def expected_matches(
    pointmap: Pointmap,
    T_fk: Sim3,
    camera: CameraModel,
) -> npt.NDArray[np.float32]:
    """[H, W, 2] px where the pose puts the keyframe's pixels; those of unknown depth are taken to
    be at the median of the others."""
    points = T_fk.apply(_points(pointmap))
    points[..., 2] = np.maximum(points[..., 2], 1e-3)
    return camera.project(points).astype(np.float32)


def _points(pointmap: Pointmap, down: int = 1, across: int = 1) -> npt.NDArray[np.float64]:
    """[H / down, W / across, 3] in the camera frame of the keyframe."""
    rho = pointmap.rho[::down, ::across]
    known = rho > 1e-6
    usual = float(np.median(rho[known])) if known.any() else 1.0
    height, width = pointmap.rho.shape
    u, v = np.meshgrid(np.arange(0, width, across) + 0.5, np.arange(0, height, down) + 0.5)
    rays = pointmap.camera.unproject(np.stack([u, v], axis=-1))
    return np.asarray(rays / np.where(known, rho, usual)[..., None])


# --------------------------------------------------------------------------------------------------
# Matches with a keyframe's pointmap as the problem that the pose solver solves.


def pose_problem(
    pointmap: Pointmap,
    pixels_k: Array,  # [M, 2] px, in the keyframe, where its depth is known
    pixels: Array,  # [M, 2] px, in the frame
    camera: CameraModel,
    sigma_px: float,
    weights: Array | None = None,  # [M]; None: all 1
) -> PoseProblem:
    """Matches of a frame seen by ``camera`` with the points of a keyframe's ``pointmap``."""
    rho = at_pixels(pointmap.rho, pixels_k)
    return PoseProblem(
        pointmap.camera.unproject(pixels_k) / rho[:, None],
        at_pixels(pointmap.variance, pixels_k),
        pixels,
        np.ones(len(pixels)) if weights is None else weights,
        camera,
        sigma_px,
    )


# --------------------------------------------------------------------------------------------------
# Pose of a frame from its matches alone, where no prediction helps.

RANSAC_ITERATIONS = 200
"""Most samples that are tried."""
RANSAC_PX = 3.0
"""Reprojection error up to which a match agrees with a pose."""
MIN_INLIERS = 30
"""Matches that must agree on a pose."""
LEAST_WIDTH = 1e-3
"""Of a set of points over its length; thinner is a line, to the depths' own precision."""


def pose_from_scratch(problem: PoseProblem, least: int = MIN_INLIERS) -> Sim3 | None:
    """T_fk by PnP in RANSAC; None without a consensus of ``least`` matches.

    SQPnP raises on one degenerate sample (points on a line, or at one place), and with it ends the
    whole search: there P3P, which skips such samples, searches again.
    """
    import cv2

    if len(problem.points) < least:
        return None
    try:
        pose = _consensus(problem, cv2.SOLVEPNP_SQPNP, least)
    except cv2.error:
        line = not _is_no_line(problem.points)
        pose = None if line else _consensus(problem, cv2.SOLVEPNP_AP3P, least)
    return pose if pose is not None and pose.is_finite() else None


def _is_no_line(
    points: npt.NDArray[np.float64],  # [N, 3]
) -> bool:
    """True if the points span a plane; around a line the camera could be anywhere."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > LEAST_WIDTH * spread[0])


def _consensus(problem: PoseProblem, solver: int, least: int) -> Sim3 | None:
    import cv2

    rays = problem.camera.unproject(problem.pixels)[:, :2]
    found, w, t, inliers = cv2.solvePnPRansac(
        problem.points,
        rays,
        np.eye(3),
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=RANSAC_PX / problem.camera.fx,
        flags=solver,
    )
    if not found or inliers is None or len(inliers) < least:
        return None
    rotation, translation = (np.asarray(each[:, 0], dtype=np.float64) for each in (w, t))
    return Sim3(so3_exp(rotation), translation)
