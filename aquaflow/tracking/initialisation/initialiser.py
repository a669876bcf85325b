"""Two-view initialisation that waits for parallax (notes/2026-11-tracking.md#initialisation).

Frames are matched to one reference until the parallax decides the geometry. Essential-matrix and
homography poses are then compared; the best hypothesis gives the waiting frames their poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import InitialisationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import (
    MIN_MATCHES,
    pose_candidates,
    rotation_compensated_parallax_px,
    triangulate,
)
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.initialisation.bundle import MAX_ITERATIONS, Bundle, BundleResult, adjust
from aquaflow.tracking.pose.depth_fusion import fuse
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Initialised:
    """The best hypothesis: poses ``T_fk`` of the frames that count, scale set by median depth 1."""

    waiting: list[MatchedFrame]
    T: list[Sim3]
    camera: CameraModel
    """With the refined focal length, where it was unknown."""
    residual_px: float
    focal_sigma: float


RETRY_GROWTH = 1.05
"""Growth of the parallax after which a geometry that could not be trusted is tried again: an
attempt takes seconds, and the next frame alone changes little."""


AS_FAR, NEAR = 0.9, 0.5
"""Of the largest parallax: the camera is as far from the reference again; it was near meanwhile."""

LASTING = 0.6
"""Share of the sure matches that lasts from one frame to the next, below which a start does not
wait. Forwards in a tiled pool it is 0.27 to 0.5; reef, Curasao and IUI3, frame by frame: 0.85."""

SURE = 0.1
"""Confidence of a match that candidate geometries are made from, where there are enough of them."""
UNSURE = 0.03
"""Confidence below which a match has no weight, where enough are sure: next to depth edges it
follows what is in front, and on a periodic floor it is that of a neighbouring tile. Without this
bound the pool of 70 pictures came in two maps instead of one."""
HALF_CONFIDENCE = 0.05
"""Confidence at which a match's variance is twice that of a sure one. Distance of Curasao's matches
from the epipolar line of the true pose, median: 0.22 px at a confidence over 0.3, 0.25 over 0.1,
0.28 over 0.03, 0.42 over 0.01, 0.57 over 0.003, 0.9 below."""


class Initialiser:
    """Collects frames matched to one reference and solves their geometry once it is determined."""

    def __init__(
        self,
        frame: Frame,
        reference: Encoding,
        prior: Prior,
        config: InitialisationConfig,
    ) -> None:
        self.frame, self.reference = frame, reference
        self.waiting: list[MatchedFrame] = []
        """Frames that see the reference, in their order."""
        self._prior, self._config = prior, config
        self._predicted: npt.NDArray[np.float32] | None = None
        self._tried_px = 0.0
        """Parallax at the last attempt."""
        self._least_since_px = 0.0
        """Least parallax since the largest one."""
        self._sure: list[int] = []
        """Sure matches of the frames so far, in their order."""
        self.contradicted = False
        """True if no geometry explained the matches of the last attempt, which had little parallax,
        or those of the newest frame are not sure any more: they have gone wrong."""
        self._samples = grid_samples(reference.interesting, config.points)

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
        weights = match_weights(pair, rows, columns, UNSURE)
        self._sure.append(int((weights > SURE / (SURE + HALF_CONFIDENCE)).sum()))
        # What is not a number compares with nothing: one such frame would hold up every start.
        parallax = parallax if np.isfinite(parallax) else 0.0
        farther = parallax > self.parallax_px
        self._least_since_px = parallax if farther else min(parallax, self._least_since_px)
        self.waiting.append(MatchedFrame(frame, pixels, weights, parallax, pair))
        self._predicted = pair.matches
        return True

    def thin(self) -> list[Frame]:
        """Remove the frame that adds least parallax, if there are more than are kept; that
        frame, whose pose can be filled in later."""
        if len(self.waiting) <= self._config.max_waiting:
            return []
        steps = np.diff([frame.parallax_px for frame in self.waiting[:-1]])
        return [self.waiting.pop(int(np.argmin(np.abs(steps))) + 1).frame]

    @property
    def parallax_px(self) -> float:
        """Largest of the waiting frames; 0 without any."""
        return max((frame.parallax_px for frame in self.waiting), default=0.0)

    @property
    def ready(self) -> bool:
        """Enough parallax and, unless the motion is fast, enough views to judge it by; or so few
        matches left that the next frame may have none."""
        enough = self.parallax_px >= self._needed_px
        return len(self.waiting) >= self._config.min_views and (enough or self.fading)

    @property
    def fading(self) -> bool:
        """Too few sure matches, or so many fewer than a frame ago that few more frames will do.

        Of a camera that moves along its view, the median parallax is small whatever the geometry is
        known to: most of the picture is far, or near the epipole. Where the ground repeats itself,
        what is near moves by a whole period after a few frames, and matches are wrong from then on.
        """
        if len(self._sure) < 2 or self.parallax_px < RETRY_GROWTH * self._tried_px:
            return False
        before, now = self._sure[-2:]
        return now < MIN_MATCHES or now < LASTING * before

    @property
    def turned_back(self) -> bool:
        """The camera came back to the reference, and is as far from it again as it was at most.

        One that swings about a place, or goes up and down it, never has the parallax that is needed
        to a reference in the middle, but may have it from end to end: twice as much, at most.
        """
        largest = self.parallax_px
        return (
            bool(self.waiting)
            and 2.0 * largest >= self._needed_px
            and self._least_since_px <= NEAR * largest
            and self.waiting[-1].parallax_px >= AS_FAR * largest
        )

    @property
    def _enough_px(self) -> float:
        return self._config.parallax_widths * self.reference.camera.width

    @property
    def _needed_px(self) -> float:
        return max(self._enough_px, RETRY_GROWTH * self._tried_px)

    def solve(self) -> Initialised | None:
        """The best explanation of the waiting frames; where there is none that is good enough, of
        those whose matches are sure; None where there is none of them either."""
        sure = [frame for frame in self.waiting if frame.is_sure]
        found = self._explain(self.waiting)
        if found is None and 0 < len(sure) < len(self.waiting):
            found = self._explain(sure)
            self.contradicted |= self.parallax_px < self._enough_px and not self.waiting[-1].is_sure
        self._tried_px = self.parallax_px  # not where this raised: the next frame tries again
        return found

    def _explain(self, frames: list[MatchedFrame]) -> Initialised | None:
        """The best explanation of these frames; where parallax is small, of those that it explains,
        since one whose matches are a period off bends the geometry of the others. None where it is
        not good enough."""
        camera, pixels = self.reference.camera, self._pixels_reference
        hypotheses = Hypotheses(camera, pixels, frames, self._config)
        result = hypotheses.best()
        explained = 0.0 if result is None else hypotheses.explained_share(result.bundle)
        parallax_px = max((frame.parallax_px for frame in frames), default=0.0)
        little = parallax_px < self._enough_px
        self.contradicted = little and explained < self._config.min_explained
        if result is None or not self._trustworthy(hypotheses, explained, result, parallax_px):
            return None
        if little:
            good = hypotheses.explained_frames(result.bundle)
            if len(good) < len(frames):
                return self._explain(good)
            if not self._is_decided(hypotheses, result):
                return None
        return Initialised(
            frames, result.bundle.T, result.bundle.camera, result.residual_px, result.focal_sigma
        )

    def _trustworthy(
        self, hypotheses: Hypotheses, explained: float, result: BundleResult, parallax_px: float
    ) -> bool:
        focal_known = (
            result.focal_sigma <= self._config.max_focal_sigma
            or parallax_px > 3.0 * self._config.parallax_widths * result.bundle.camera.width
        )
        return (
            parallax_px > self._config.sigma_px  # less is noise, which has depths of its own
            and explained >= self._config.min_explained
            and hypotheses.depth_sigma(result) <= self._config.max_depth_sigma
            and focal_known
        )

    def _is_decided(self, hypotheses: Hypotheses, result: BundleResult) -> bool:
        """True if depths and direction are known, however little parallax there is: at the noise
        that matches are known to have, not that of the few that are left, and without a rival."""
        worse = max(self._config.sigma_px / result.residual_px, 1.0)
        known = worse * hypotheses.depth_sigma(result) <= self._config.max_depth_sigma
        return known and not hypotheses.ambiguous

    @property
    def _pixels_reference(self) -> Array:
        rows, columns = self._samples
        return np.stack([columns + 0.5, rows + 0.5], -1)


def calibrate(camera: CameraModel) -> CameraModel:
    """The same camera, no longer a guess."""
    return replace(camera, calibrated=True)


def match_weights(
    pair: PairGeometry,
    rows: npt.NDArray[np.intp],  # [P]
    columns: npt.NDArray[np.intp],  # [P]
    least: float,
) -> Array:
    """[P] information of the matches at some pixels, over that of the surest; 0 where there is
    none, and, where enough are sure, of those with less confidence than ``least``."""
    stated = pair.C[rows, columns]
    # One that is no number would make the whole cost none.
    counts = pair.valid[rows, columns] & (stated > 0.0)
    confidence = np.where(counts, stated, 0.0).astype(np.float64)
    if (confidence > SURE).sum() >= MIN_MATCHES:
        confidence[confidence < least] = 0.0
    return confidence / (confidence + HALF_CONFIDENCE)


def grid_samples(
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


# --------------------------------------------------------------------------------------------------
# Hypotheses of the geometry of frames matched to one reference; the best explains them.
#
# Essential-matrix and homography poses, at each focal length that may be, are extended to some of
# the frames, bundle-adjusted, and judged by how well they explain them. The best one is adjusted to
# all.

FEW_STEPS = 6
"""Of the adjustment that every candidate gets. The right ones need 5 to 11, a wrong one 20 and more
(reef clip, calibrated)."""
HOPELESS = 1.1
"""Median residual after these steps, over the least one, from which a candidate is given up. The
reef clip's wrong ones are at 2.1, its right ones within 1.02; Curasao's, every 2nd, at 1.4 and,
from the pair that converges soon, 1.01."""

WIDE, LEAST_WIDE = 0.6, 4
"""Share of the largest parallax from which a frame takes part in the last adjustment, and how many
take part at least. Errors of matches to one reference are alike from frame to frame, and count for
more the less parallax there is: with all 24 frames of Curasao's starts from pictures 180 and 196
the rotations were 0.18 degrees off, with those from 0.3 on 0.16, from 0.6 on 0.08 and 0.05."""

RIVAL_DEG = 5.0
"""Between directions of motion of two geometries that are not the same one: the decompositions of a
plane's homography are tens of degrees apart, those of one geometry converge to within one."""


@dataclass(frozen=True)
class MatchedFrame:
    """A frame matched to the reference, without a pose yet."""

    frame: Frame
    pixels: Array
    """[P, 2] px, where the reference's sample points are seen."""
    weights: Array
    """[P] information of the match, over that of the surest; 0 where the sample is not seen."""
    parallax_px: float
    pair: PairGeometry

    @property
    def observed(self) -> npt.NDArray[np.bool_]:
        """[P] samples that are seen."""
        return self.weights > 0.0

    @property
    def is_sure(self) -> bool:
        """True if enough of the matches are sure: where the ground repeats itself, those of a frame
        that is too far away are of a whole period off, all of them."""
        return int(self._sure.sum()) >= MIN_MATCHES

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """[P] samples whose match is sure; all that are seen where these are too few."""
        return self._sure if self.is_sure else self.observed

    @property
    def _sure(self) -> npt.NDArray[np.bool_]:
        return self.weights > SURE / (SURE + HALF_CONFIDENCE)


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
        self._wide = _wide_frames(waiting)
        """The frames that the geometry is solved from; the others get their poses from it."""
        self.ambiguous = False
        """True if another direction of motion explained the frames as well as the best."""

    def best(self) -> BundleResult | None:
        """The best candidate, adjusted to the wide frames, with the poses of all frames in their
        order; None without candidates."""
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
        T = self._poses(best, test_frames, self._wide)
        found = self._adjust(replace(best.bundle, T=T), self._wide)
        T = self._poses(found, self._wide, self._waiting)
        return replace(found, bundle=replace(found.bundle, T=T))

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
        """Share of all information in front of its camera and within a pixel of its match."""
        return self._explained_share(bundle, self._waiting)

    def explained_frames(self, bundle: Bundle) -> list[MatchedFrame]:
        """Frames of which enough is explained each."""
        return [
            frame
            for frame, T in zip(self._waiting, bundle.T, strict=True)
            if self._explained_share(replace(bundle, T=[T]), [frame]) >= self._config.min_explained
        ]

    def depth_sigma(self, result: BundleResult) -> float:
        """Median relative sigma of the depths that :meth:`best` found."""
        # A point that no wide frame sees has no depth to judge by; of a wide step, most are so.
        seen = np.any([frame.observed for frame in self._wide], axis=0)
        relative = result.rho_sigma[seen] / np.maximum(result.bundle.rho[seen], 1e-6)
        return float(np.median(relative))

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
                seen = second.sure
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

    def _poses(
        self, found: BundleResult, adjusted: list[MatchedFrame], frames: list[MatchedFrame]
    ) -> list[Sim3]:
        """Poses of ``frames`` in the geometry that was found from the ``adjusted`` ones."""
        known = {id(frame): T for frame, T in zip(adjusted, found.bundle.T, strict=True)}
        rho, camera, variance = found.bundle.rho, found.bundle.camera, found.rho_sigma**2
        every = np.ones(len(rho), bool)
        T = []
        for frame in frames:
            near = min(adjusted, key=lambda near: abs(near.parallax_px - frame.parallax_px))
            own = known.get(id(frame))
            T.append(own or self._pose_frame(frame, camera, rho, variance, every, known[id(near)]))
        return T

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
            frame.weights[seen],
            camera,
            self._config.sigma_px,
        )
        estimate = solve_pose(problem, guess)
        return estimate.T if estimate is not None else guess

    def _adjust(
        self, start: Bundle, frames: list[MatchedFrame], steps: int = MAX_ITERATIONS
    ) -> BundleResult:
        pixels = np.stack([frame.pixels for frame in frames])
        weights = np.stack([frame.weights for frame in frames])
        solve_focal = not start.camera.calibrated and len(frames) >= 2
        return adjust(self._pixels_reference, pixels, weights, start, solve_focal, steps)

    def _explained_share(self, bundle: Bundle, frames: list[MatchedFrame]) -> float:
        rays = bundle.camera.unproject(self._pixels_reference)
        hits, total = 0.0, 0.0
        for frame, T in zip(frames, bundle.T, strict=True):
            Y = rays @ T.R.T + bundle.rho[:, None] * T.t
            error = np.linalg.norm(bundle.camera.project(Y) - frame.pixels, axis=1)
            good = (Y[:, 2] > 1e-3) & (error < self._config.inlier_px)
            hits += float(frame.weights[good].sum())
            total += float(frame.weights.sum())
        return hits / total if total > 0.0 else 0.0


def _wide_frames(waiting: list[MatchedFrame]) -> list[MatchedFrame]:
    """Those with most of the largest parallax, in their order; at least ``LEAST_WIDE``."""
    by_parallax = sorted((frame.parallax_px for frame in waiting), reverse=True)
    if not by_parallax:
        return []
    least = min(WIDE * by_parallax[0], by_parallax[min(LEAST_WIDE, len(waiting)) - 1])
    return [frame for frame in waiting if frame.parallax_px >= least]


def _direction(T: Sim3) -> Array:
    """[3] unit vector to the camera of ``T``, from the reference."""
    centre = -T.R.T @ T.t
    return np.asarray(centre / max(float(np.linalg.norm(centre)), 1e-12))


def _on_the_way(T: Sim3, share: float) -> Sim3:
    """An initial pose between the reference and ``T``, interpolated."""
    return Sim3(T.R, T.t * min(share, 1.0)) if share > 0.5 else Sim3.identity()
