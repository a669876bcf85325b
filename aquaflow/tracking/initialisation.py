"""Two-view initialisation that waits for parallax (prior_notes.md section 2: what fails first).

Frames are matched to one reference until the parallax decides the geometry. Essential-matrix and
homography poses then compete: each is extended to all waiting frames, bundle-adjusted, and judged
by how well it explains every one of them. The waiting frames get their poses from the winner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import InitialisationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.triangulation import triangulate
from aquaflow.geometry.two_view import (
    MIN_MATCHES,
    pose_candidates,
    rotation_compensated_parallax_px,
)
from aquaflow.keyframes import Pointmap
from aquaflow.messages import Frame
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.bundle import Bundle, BundleResult, adjust
from aquaflow.tracking.fusion import fuse
from aquaflow.tracking.solver import PoseProblem, solve_pose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Waiting:
    """A frame matched to the reference, without a pose yet."""

    frame: Frame
    pixels: Array
    """[P, 2] px, where the reference's sample points are seen."""
    observed: npt.NDArray[np.bool_]
    """[P]"""
    parallax_px: float
    pair: PairGeometry


@dataclass(frozen=True)
class Initialised:
    """The winner: relative poses ``T_fk`` of the waiting frames, scale set by median depth 1."""

    waiting: list[Waiting]
    T: list[Sim3]
    camera: CameraModel
    """With the refined focal length, where it was unknown."""
    residual_px: float
    focal_sigma: float


RETRY_GROWTH = 1.05
"""Growth of the parallax after which a geometry that could not be trusted is tried again: an
attempt takes seconds, and the next frame alone changes little."""


class Initialiser:
    """Collects frames against one reference and says when the geometry is decided."""

    def __init__(
        self,
        frame: Frame,
        reference: Encoding,
        prior: Prior,
        config: InitialisationConfig,
    ) -> None:
        self.frame, self.reference = frame, reference
        self.waiting: list[Waiting] = []
        self.thinned: list[Frame] = []
        """Frames that were let go to bound memory; their poses can be filled in later."""
        self._prior, self._config = prior, config
        self._predicted: npt.NDArray[np.float32] | None = None
        self._tried_px = 0.0
        """Parallax at the last attempt."""
        self._samples = _grid_samples(reference.interesting, config.points)

    def add(self, frame: Frame, encoding: Encoding) -> bool:
        """Match a frame to the reference; False when it no longer sees the same place."""
        pair = self._prior.decode(self.reference, encoding, self._predicted)
        rows, columns = self._samples
        observed = pair.valid[rows, columns]
        if observed.sum() < MIN_MATCHES or observed.mean() < self._config.min_share:
            return False
        pixels = pair.matches[rows, columns].astype(np.float64)
        parallax = rotation_compensated_parallax_px(
            self._pixels_reference[observed], pixels[observed], self.reference.camera
        )
        self.waiting.append(Waiting(frame, pixels, observed, parallax, pair))
        self._predicted = pair.matches
        self._thin()
        return True

    @property
    def parallax_px(self) -> float:
        return max((frame.parallax_px for frame in self.waiting), default=0.0)

    @property
    def ready(self) -> bool:
        """Enough parallax and, unless the motion is fast, enough views to judge it by."""
        return (
            len(self.waiting) >= self._config.min_views
            and self.parallax_px >= self._config.parallax_widths * self.reference.camera.width
            and self.parallax_px >= RETRY_GROWTH * self._tried_px
        )

    def solve(self) -> Initialised | None:
        """The best explanation of all waiting frames; None when none is good enough."""
        self._tried_px = self.parallax_px
        best: tuple[float, BundleResult] | None = None
        best_rank = (-1.0, 0.0)
        for start in self._starts():
            result = self._adjust(start)
            explained = self._explained(result.bundle)
            # Over a plane two geometries explain every match; then the residual tells them apart.
            rank = (round(explained, 2), -result.residual_px)
            if best is None or rank > best_rank:
                best, best_rank = (explained, result), rank
        if best is None or not self._trustworthy(*best):
            return None
        result = best[1]
        return Initialised(
            self.waiting,
            result.bundle.T,
            result.bundle.camera,
            result.residual_px,
            result.focal_sigma,
        )

    def _starts(self) -> list[Bundle]:
        """Candidate geometries from the pairs with the most parallax, at each candidate focal."""
        order = sorted(self.waiting, key=lambda frame: -frame.parallax_px)
        starts = []
        for camera in self._cameras():
            for second in order[: self._config.pairs]:
                seen = second.observed
                candidates = pose_candidates(
                    self._pixels_reference[seen], second.pixels[seen], camera, camera
                )
                for candidate in candidates[: self._config.candidates]:
                    bundle = self._extend(camera, second, candidate.T_ba)
                    if bundle is not None:
                        starts.append(bundle)
        return starts

    def _cameras(self) -> list[CameraModel]:
        camera = self.reference.camera
        if camera.calibrated:
            return [camera]
        return [camera.with_focal_scaled(factor) for factor in self._config.focal_factors]

    def _extend(self, camera: CameraModel, second: Waiting, T_ba: Sim3) -> Bundle | None:
        """Triangulate with one pair, then pose every other waiting frame against the points."""
        rays = camera.unproject(self._pixels_reference)
        points = triangulate(rays, second.pixels, T_ba, camera, self._config.sigma_px)
        good = points.good & second.observed
        if good.sum() < MIN_MATCHES:
            return None
        rho = np.where(good, points.rho, np.median(points.rho[good]))
        variance = np.where(good, points.variance, (0.5 * rho) ** 2)
        poses = []
        for frame in self.waiting:
            seen = frame.observed & good
            if frame is second or seen.sum() < MIN_MATCHES:
                poses.append(T_ba)
                continue
            problem = PoseProblem(
                rays[seen] / rho[seen, None],
                variance[seen],
                frame.pixels[seen],
                np.ones(int(seen.sum())),
                camera,
                self._config.sigma_px,
            )
            share = frame.parallax_px / max(second.parallax_px, 1e-6)
            guess = Sim3(T_ba.R, T_ba.t * min(share, 1.0)) if share > 0.5 else Sim3.identity()
            estimate = solve_pose(problem, guess)
            poses.append(estimate.T if estimate is not None else guess)
        return Bundle(poses, rho, camera)

    def _adjust(self, start: Bundle) -> BundleResult:
        pixels = np.stack([frame.pixels for frame in self.waiting])
        observed = np.stack([frame.observed for frame in self.waiting])
        solve_focal = not start.camera.calibrated and len(self.waiting) >= 2
        return adjust(self._pixels_reference, pixels, observed, start, solve_focal)

    def _explained(self, bundle: Bundle) -> float:
        """Share of all observations in front of their camera and within a pixel of their match."""
        rays = bundle.camera.unproject(self._pixels_reference)
        hits, total = 0, 0
        for frame, T in zip(self.waiting, bundle.T, strict=True):
            Y = rays @ T.R.T + bundle.rho[:, None] * T.t
            error = np.linalg.norm(bundle.camera.project(Y) - frame.pixels, axis=1)
            good = (Y[:, 2] > 1e-3) & (error < self._config.inlier_px) & frame.observed
            hits += int(good.sum())
            total += int(frame.observed.sum())
        return hits / max(total, 1)

    def _trustworthy(self, explained: float, result: BundleResult) -> bool:
        relative = result.rho_sigma / np.maximum(result.bundle.rho, 1e-6)
        focal_known = (
            result.focal_sigma <= self._config.max_focal_sigma
            or self.parallax_px > 3.0 * self._config.parallax_widths * result.bundle.camera.width
        )
        return (
            self.parallax_px > self._config.sigma_px  # less is noise, which has depths of its own
            and explained >= self._config.min_explained
            and float(np.median(relative)) <= self._config.max_depth_sigma
            and focal_known
        )

    @property
    def _pixels_reference(self) -> Array:
        rows, columns = self._samples
        return np.stack([columns + 0.5, rows + 0.5], -1)

    def _thin(self) -> None:
        """Keep the number of waiting frames bounded: drop the one that adds least parallax."""
        if len(self.waiting) <= self._config.max_waiting:
            return
        steps = np.diff([frame.parallax_px for frame in self.waiting[:-1]])
        self.thinned.append(self.waiting.pop(int(np.argmin(np.abs(steps))) + 1).frame)


def calibrated(camera: CameraModel) -> CameraModel:
    """The same camera, no longer a guess."""
    return replace(camera, calibrated=True)


def _grid_samples(
    interesting: npt.NDArray[np.bool_],  # [H, W]
    count: int,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of about ``count`` interesting pixels on a regular grid."""
    height, width = interesting.shape
    step = max(1, int(np.sqrt(height * width / count)))
    grid = np.zeros_like(interesting)
    grid[step // 2 :: step, step // 2 :: step] = True
    rows, columns = np.nonzero(grid & interesting)
    return rows, columns


def fused_pointmap(solution: Initialised, camera: CameraModel, sigma_px: float) -> Pointmap:
    """The reference's pointmap from all waiting frames, best parallax first."""
    pointmap = Pointmap.unknown(camera)
    pairs = sorted(
        zip(solution.waiting, solution.T, strict=True), key=lambda item: -item[0].parallax_px
    )
    for waiting, T in pairs:
        fuse(pointmap, waiting.pair, T, camera, sigma_px)
    return pointmap
