"""Hypotheses of the geometry of frames matched to one reference; the best explains them.

Essential-matrix and homography poses, at each focal length that may be, are extended to some of the
frames, bundle-adjusted, and judged by how well they explain them. The best one is adjusted to all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import InitialisationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import MIN_MATCHES, pose_candidates, triangulate
from aquaflow.prior.contract import PairGeometry
from aquaflow.tracking.initialisation.bundle import MAX_ITERATIONS, Bundle, BundleResult, adjust
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]

FEW_STEPS = 6
"""Of the adjustment that every candidate gets. The right ones need 5 to 11, a wrong one 20 and more
(reef clip, calibrated)."""
HOPELESS = 1.1
"""Median residual after these steps, over the least one, from which a candidate is given up. The
reef clip's wrong ones are at 2.1, its right ones within 1.02; Curasao's, every 2nd, at 1.4 and,
from the pair that converges soon, 1.01."""

RIVAL_DEG = 5.0
"""Between directions of motion of two geometries that are not the same one: the decompositions of a
plane's homography are tens of degrees apart, those of one geometry converge to within one."""


@dataclass(frozen=True)
class MatchedFrame:
    """A frame matched to the reference, without a pose yet."""

    frame: Frame
    pixels: Array
    """[P, 2] px, where the reference's sample points are seen."""
    observed: npt.NDArray[np.bool_]
    """[P]"""
    parallax_px: float
    pair: PairGeometry


class Hypotheses:
    """One reference view and the frames that wait for their poses against it."""

    def __init__(
        self,
        camera: CameraModel,
        pixels_reference: Array,  # [P, 2] px
        waiting: list[MatchedFrame],
        config: InitialisationConfig,
    ) -> None:
        self._camera, self._config, self._waiting = camera, config, waiting
        self._pixels_reference = pixels_reference
        self.ambiguous = False
        """True if another direction of motion explained the frames as well as the best."""

    def best(self) -> BundleResult | None:
        """The best candidate, adjusted to all frames in their order; None without candidates."""
        test_frames = self._test_frames()
        few = [self._adjust(each, test_frames, FEW_STEPS) for each in self._starts(test_frames)]
        if not few:
            return None
        limit = HOPELESS * min(result.residual_px for result in few)
        hopeful = [result.bundle for result in few if result.residual_px <= limit]
        judged = [self._adjust(bundle, test_frames) for bundle in hopeful]
        # Over a plane two geometries explain every match; then the residual decides.
        best = max(
            judged,
            key=lambda result: (
                round(self._explained_share(result.bundle, test_frames), 2),
                -result.residual_px,
            ),
        )
        self.ambiguous = any(self._is_rival(each, best) for each in judged)
        return self._adjust(self._complete(best, test_frames), self._waiting)

    @staticmethod
    def _is_rival(result: BundleResult, best: BundleResult) -> bool:
        """True of a geometry that is another one, and no worse."""
        if result.residual_px > HOPELESS * best.residual_px:
            return False
        far = max(
            range(len(best.bundle.T)), key=lambda v: float(np.linalg.norm(best.bundle.T[v].t))
        )
        mine, other = (_direction(each.bundle.T[far]) for each in (best, result))
        return bool(mine @ other < np.cos(np.radians(RIVAL_DEG)))

    def explained_share(self, bundle: Bundle) -> float:
        """Share of all observations in front of their camera and within a pixel of their match."""
        return self._explained_share(bundle, self._waiting)

    def _test_frames(self) -> list[MatchedFrame]:
        """The pairs' frames, which have most parallax, and some of the others down to the least."""
        order = sorted(self._waiting, key=lambda frame: -frame.parallax_px)
        first, rest = order[: self._config.pairs], order[self._config.pairs :]
        count = min(self._config.judges - len(first), len(rest))
        others = np.linspace(len(rest) - 1, 0, max(count, 0)).round().astype(int)
        return first + [rest[i] for i in sorted(others)]

    def _starts(self, test_frames: list[MatchedFrame]) -> list[Bundle]:
        """Candidate geometries from the pairs with the most parallax, at each candidate focal."""
        starts = []
        for camera in self._cameras():
            for second in test_frames[: self._config.pairs]:
                seen = second.observed
                candidates = pose_candidates(
                    self._pixels_reference[seen], second.pixels[seen], camera, camera
                )
                for candidate in candidates[: self._config.candidates]:
                    bundle = self._extend(camera, second, candidate.T_ba, test_frames)
                    if bundle is not None:
                        starts.append(bundle)
        return starts

    def _cameras(self) -> list[CameraModel]:
        camera = self._camera
        if camera.calibrated:
            return [camera]
        return [camera.with_focal_scaled(factor) for factor in self._config.focal_factors]

    def _extend(
        self, camera: CameraModel, second: MatchedFrame, T_ba: Sim3, test_frames: list[MatchedFrame]
    ) -> Bundle | None:
        """Triangulate with one pair, then pose every other test frame against the points."""
        rays = camera.unproject(self._pixels_reference)
        points = triangulate(rays, second.pixels, T_ba, camera, self._config.sigma_px)
        good = points.good & second.observed
        if good.sum() < MIN_MATCHES:
            return None
        rho = np.where(good, points.rho, np.median(points.rho[good]))
        variance = np.where(good, points.variance, (0.5 * rho) ** 2)
        T = []
        for frame in test_frames:
            near = _on_the_way(T_ba, frame.parallax_px / max(second.parallax_px, 1e-6))
            known = frame is second
            T.append(T_ba if known else self._pose_frame(frame, camera, rho, variance, good, near))
        return Bundle(T, rho, camera)

    def _complete(self, best: BundleResult, test_frames: list[MatchedFrame]) -> Bundle:
        """The test frames' geometry with the poses of all waiting frames."""
        known = {id(frame): T for frame, T in zip(test_frames, best.bundle.T, strict=True)}
        rho, camera = best.bundle.rho, best.bundle.camera
        sure = np.ones(len(rho), bool)
        T = []
        for frame in self._waiting:
            near = min(test_frames, key=lambda near: abs(near.parallax_px - frame.parallax_px))
            own = known.get(id(frame))
            if own is None:
                own = self._pose_frame(frame, camera, rho, best.rho_sigma**2, sure, known[id(near)])
            T.append(own)
        return Bundle(T, rho, camera)

    def _pose_frame(
        self,
        frame: MatchedFrame,
        camera: CameraModel,
        rho: Array,  # [P]
        variance: Array,  # [P] of rho
        good: npt.NDArray[np.bool_],  # [P]
        guess: Sim3,
    ) -> Sim3:
        """Reference to ``frame`` by the points that are good; the guess where that fails."""
        seen = frame.observed & good
        if seen.sum() < MIN_MATCHES:
            return guess
        problem = PoseProblem(
            camera.unproject(self._pixels_reference)[seen] / rho[seen, None],
            variance[seen],
            frame.pixels[seen],
            np.ones(int(seen.sum())),
            camera,
            self._config.sigma_px,
        )
        estimate = solve_pose(problem, guess)
        return estimate.T if estimate is not None else guess

    def _adjust(
        self, start: Bundle, frames: list[MatchedFrame], steps: int = MAX_ITERATIONS
    ) -> BundleResult:
        pixels = np.stack([frame.pixels for frame in frames])
        observed = np.stack([frame.observed for frame in frames])
        solve_focal = not start.camera.calibrated and len(frames) >= 2
        return adjust(self._pixels_reference, pixels, observed, start, solve_focal, steps)

    def _explained_share(self, bundle: Bundle, frames: list[MatchedFrame]) -> float:
        rays = bundle.camera.unproject(self._pixels_reference)
        hits, total = 0, 0
        for frame, T in zip(frames, bundle.T, strict=True):
            Y = rays @ T.R.T + bundle.rho[:, None] * T.t
            error = np.linalg.norm(bundle.camera.project(Y) - frame.pixels, axis=1)
            good = (Y[:, 2] > 1e-3) & (error < self._config.inlier_px) & frame.observed
            hits += int(good.sum())
            total += int(frame.observed.sum())
        return hits / max(total, 1)


def _direction(T: Sim3) -> Array:
    """[3] unit vector to the camera of ``T``, from the reference."""
    centre = -T.R.T @ T.t
    return np.asarray(centre / max(float(np.linalg.norm(centre)), 1e-12))


def _on_the_way(T: Sim3, share: float) -> Sim3:
    """An initial pose between the reference and ``T``, interpolated."""
    return Sim3(T.R, T.t * min(share, 1.0)) if share > 0.5 else Sim3.identity()
