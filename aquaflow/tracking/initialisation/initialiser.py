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
    rotation_compensated_parallax_px,
)
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding, Prior
from aquaflow.tracking.initialisation.bundle import BundleResult
from aquaflow.tracking.initialisation.hypotheses import Hypotheses, MatchedFrame
from aquaflow.tracking.pose.depth_fusion import fuse
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Initialised:
    """The best hypothesis: poses ``T_fk`` of the waiting frames, scale set by median depth 1."""

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

MIN_CONFIDENCE = 0.1
"""Of a match that decides the geometry, where there are enough of them. Next to depth edges, where
the match follows what is in front, it is below; the first keyframe's depths, bent by such matches,
turned every link for 70 frames (notes/2026-11-tracking.md#forward-views)."""


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
        """True if no geometry explained the matches of the last attempt, which had little parallax:
        they have gone wrong."""
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
        sure = observed & (pair.C[rows, columns] > MIN_CONFIDENCE)
        self._sure.append(int(sure.sum()))
        if sure.sum() >= MIN_MATCHES:
            observed = sure
        # What is not a number compares with nothing: one such frame would hold up every start.
        parallax = parallax if np.isfinite(parallax) else 0.0
        farther = parallax > self.parallax_px
        self._least_since_px = parallax if farther else min(parallax, self._least_since_px)
        self.waiting.append(MatchedFrame(frame, pixels, observed, parallax, pair))
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
        """The best explanation of all waiting frames; None when none is good enough."""
        camera, pixels = self.reference.camera, self._pixels_reference
        hypotheses = Hypotheses(camera, pixels, self.waiting, self._config)
        result = hypotheses.best()
        explained = 0.0 if result is None else hypotheses.explained_share(result.bundle)
        trusted = result is not None and self._trustworthy(explained, result)
        little = self.parallax_px < self._enough_px
        if little:
            trusted = trusted and result is not None and self._is_decided(hypotheses, result)
        self.contradicted = little and explained < self._config.min_explained
        self._tried_px = self.parallax_px  # not where this raised: the next frame tries again
        if result is None or not trusted:
            return None
        return Initialised(
            self.waiting,
            result.bundle.T,
            result.bundle.camera,
            result.residual_px,
            result.focal_sigma,
        )

    def _trustworthy(self, explained: float, result: BundleResult) -> bool:
        # A point that no waiting frame sees has no depth to judge by; of a wide step, most are so.
        seen = np.any([frame.observed for frame in self.waiting], axis=0)
        relative = result.rho_sigma[seen] / np.maximum(result.bundle.rho[seen], 1e-6)
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

    def _is_decided(self, hypotheses: Hypotheses, result: BundleResult) -> bool:
        """True if depths and direction are known, however little parallax there is: at the noise
        that matches are known to have, not that of the few that are left, and without a rival."""
        worse = max(self._config.sigma_px / result.residual_px, 1.0)
        seen = np.any([frame.observed for frame in self.waiting], axis=0)
        relative = worse * result.rho_sigma[seen] / np.maximum(result.bundle.rho[seen], 1e-6)
        known = float(np.median(relative)) <= self._config.max_depth_sigma
        return known and not hypotheses.ambiguous

    @property
    def _pixels_reference(self) -> Array:
        rows, columns = self._samples
        return np.stack([columns + 0.5, rows + 0.5], -1)


def calibrate(camera: CameraModel) -> CameraModel:
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
