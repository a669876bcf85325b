"""Is this the same place? A pose from keypoints alone, and whether chance could have made it.

Dense flow finds a tenth of a picture in any other picture, and nothing in the same one turned
round. Keypoints do neither: between pictures of different places some ten descriptors agree, and
their pixels agree on no pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig, VerificationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.keyframes.place import KeypointDepths, depths_at
from aquaflow.prior.contract import Encoding, Float, Keypoints
from aquaflow.tracking.pose.matcher import is_expected, pose_from_scratch, sample
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem, solve_pose

Array = npt.NDArray[np.float64]

GRID = (8, 6)
"""Cells of the picture, across and down, in which inliers are counted as spread."""


@dataclass(frozen=True)
class Verified:
    """A place found again: the pose of the frame at the keyframe, and what speaks for it."""

    estimate: PoseEstimate
    """``estimate.T`` is T_fk: keyframe to frame. With the frame's own pointmap its scale is free,
    and the covariance has the seventh row for it."""
    inliers: int
    """Keypoints that agree on the pose."""
    matched: int
    """Keypoints whose descriptors agree and whose depth the keyframe knows."""
    cells: int
    """Cells of the frame's picture, of 48, that hold an inlier."""


def verify(
    keyframe: Keyframe,
    encoding: Encoding,
    camera: CameraModel,
    config: VerificationConfig,
    pointmap: Pointmap | None = None,
) -> Verified | None:
    """The frame's pose at the keyframe, or None where the keypoints do not prove one.

    ``pointmap`` is the frame's own, where it has one: then the two pointmaps' scales are compared
    too, and a pair whose scales are not known to ``max_scale_sigma`` is no proof.
    """
    past = depths_at(keyframe.encoding.keypoints, keyframe.pointmap)
    own = None if pointmap is None else depths_at(encoding.keypoints, pointmap)
    return verify_keypoints(past, encoding.keypoints, camera, config, own)


def verify_keypoints(
    past: KeypointDepths,
    keypoints: Keypoints,
    camera: CameraModel,
    config: VerificationConfig,
    own: KeypointDepths | None = None,
) -> Verified | None:
    """As :func:`verify`, of keypoints alone: ``own`` are the frame's ``keypoints`` with depths."""
    mine, theirs = match_keypoints(past.keypoints, keypoints)
    kept = past.is_known(config.known_sigma)[mine]
    mine, theirs = mine[kept], theirs[kept]
    if len(mine) < config.min_inliers:
        return None
    pixels = keypoints.pixels[theirs].astype(np.float64)
    problem = PoseProblem(
        past.points()[mine], past.variance[mine], pixels, np.ones(len(mine)), camera,
        config.sigma_px,
    )  # fmt: skip
    initial = pose_from_scratch(problem)
    estimate = None if initial is None else solve_pose(problem, initial)
    if estimate is None:
        return None
    error = np.linalg.norm(camera.project(estimate.T.apply(problem.points)) - pixels, axis=1)
    inlier = error < config.inlier_px
    cells = _occupied_cells(pixels[inlier], camera)
    enough = inlier.sum() >= config.min_inliers and inlier.mean() >= config.min_inlier_share
    if not enough or cells < config.min_cells:
        return None
    if own is not None:
        estimate = _with_scale(past, own, (mine[inlier], theirs[inlier]), estimate, config)
        if estimate is None:
            return None
    return Verified(estimate, int(inlier.sum()), len(pixels), cells)


def _with_scale(
    past: KeypointDepths,
    own: KeypointDepths,
    inliers: tuple[Index, Index],  # keypoints of past and own, [M] each
    estimate: PoseEstimate,
    config: VerificationConfig,
) -> PoseEstimate | None:
    """The similarity between the two pointmaps; None where its scale stays unknown."""
    mine, theirs = inliers
    known = own.is_known(config.known_sigma)[theirs]
    if known.sum() < config.min_inliers:
        return None
    points = past.points()[mine]
    own_points = np.where(known[:, None], own.points()[theirs], np.nan)
    problem = PoseProblem(
        points,
        past.variance[mine],
        own.keypoints.pixels[theirs].astype(np.float64),
        np.ones(len(mine)),
        own.camera,
        config.sigma_px,
        frame_points=own_points,
        frame_rho_variance=np.where(known, own.variance[theirs], np.nan),
    )
    # Where the frame's pointmap has another unit, the pose found so far is that far off in depth.
    ratio = own_points[known][:, 2] / estimate.T.apply(points[known])[:, 2]
    scale = float(np.median(ratio))
    start = Sim3(estimate.T.R, scale * estimate.T.t, scale)
    similar = solve_pose(problem, start, free_scale=True)
    if similar is None or similar.covariance[6, 6] > config.max_scale_sigma**2:
        return None
    return similar


def _occupied_cells(
    pixels: Array,  # [M, 2] px
    camera: CameraModel,
) -> int:
    share = pixels / (camera.width, camera.height)
    cell = np.floor(np.clip(share, 0.0, 1.0 - 1e-9) * GRID).astype(np.int64)
    return len(np.unique(cell @ (1, GRID[0])))


# --------------------------------------------------------------------------------------------------
# Keypoints of two pictures that show the same thing.

Index = npt.NDArray[np.int64]

LOWE_RATIO = 0.8
"""Distance to the nearest over distance to the second: above, the match is not clear (Lowe)."""


def take_root(
    descriptors: Float,  # [M, d]
) -> Float:
    """[M, d] of unit length: signed square roots after L1 normalisation (RootSIFT).

    No few large entries decide how near two descriptors are.
    """
    size = np.maximum(np.abs(descriptors).sum(1, keepdims=True), 1e-12)
    share = descriptors / size
    return np.asarray(np.sign(share) * np.sqrt(np.abs(share)), dtype=np.float32)


def match_keypoints(a: Keypoints, b: Keypoints) -> tuple[Index, Index]:
    """Indices [M] into a and into b of keypoints that are each other's nearest, and clearly so."""
    if len(a.pixels) == 0 or len(b.pixels) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # Of unit length: the nearest is the one with the largest product.
    product = take_root(a.descriptors) @ take_root(b.descriptors).T
    nearest, back = product.argmax(1), product.argmax(0)
    rows = np.arange(len(product))
    best = product[rows, nearest]
    product[rows, nearest] = -np.inf
    # |x - y|^2 = 2 (1 - x . y)
    clear = 1.0 - best < LOWE_RATIO**2 * (1.0 - product.max(1))
    kept = np.nonzero(clear & (back[nearest] == rows))[0]
    return kept, nearest[kept]


# --------------------------------------------------------------------------------------------------
# Keyframes that overlap with a frame, by the poses of the keyframe graph alone.

SKETCH_POINTS = 64
"""Points kept of a keyframe: an overlap is known to about a twentieth, for 1.5 kB."""
NEAREST = 32
"""Nearest keyframes, by the distance of their centres, whose overlap is computed."""
ROLL_RAD = np.radians(20.0)
"""Turn about the viewing direction beyond which flow hardly matches two pictures: on synthetic
dives 0.63 of the picture up to 10 degrees, 0.45 at 20, and nothing from 30 on."""
CROWD_OVERLAP = 0.6
"""Predicted share in view from which a keyframe counts as one of the place."""


@dataclass(frozen=True)
class Neighbour:
    """A keyframe of the same place, by its pose."""

    keyframe: Keyframe
    T_fk: Sim3
    """Keyframe to frame, by the graph's poses."""
    overlap: float
    """Share of the keyframe's points that the frame should show."""

    @property
    def roll_rad(self) -> float:
        """Turn of the picture about the viewing direction."""
        R = self.T_fk.R
        return abs(float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])))

    @property
    def likeness(self) -> float:
        """Overlap, less where the picture is turned: most first is most worth a try."""
        return self.overlap * float(np.exp(-0.5 * (self.roll_rad / ROLL_RAD) ** 2))


class Neighbours:
    """A few points of every keyframe that was left; poses are read when they are needed, because
    the graph moves them."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._sketches: dict[int, tuple[Keyframe, Array]] = {}
        self._aside: set[int] = set()

    def add(self, keyframe: Keyframe) -> None:
        """Store the points of ``keyframe`` as it is left for the first time; they are not updated,
        so that they say later what its depths were."""
        if keyframe.number not in self._sketches and keyframe.number not in self._aside:
            points = sketch(keyframe, self._config)
            if len(points):
                self._sketches[keyframe.number] = (keyframe, points)

    def set_aside(self, keyframe: Keyframe) -> None:
        """Return to ``keyframe`` no more, and ask it about no other: its scale is wrong."""
        self._sketches.pop(keyframe.number, None)
        self._aside.add(keyframe.number)

    def points(self, keyframe: Keyframe) -> Array | None:
        """[M, 3] in its camera frame; None if it has not been left yet."""
        held = self._sketches.get(keyframe.number)
        return None if held is None else held[1]

    def around(
        self, T_wc: Sim3, camera: CameraModel, sub_map: int, besides: Keyframe
    ) -> list[Neighbour]:
        """Keyframes of ``sub_map``, but for one, of which a frame at ``T_wc`` should show
        ``crowd_overlap``, not turned too far to match; the most alike first."""
        here = [
            sketch for sketch in self._sketches.values()
            if sketch[0].sub_map == sub_map and sketch[0] is not besides
        ]  # fmt: skip
        if not here:
            return []
        centres = np.array([keyframe.T_wc.t for keyframe, _ in here])
        distance = np.linalg.norm(centres - T_wc.t, axis=1)
        T_fw, found = T_wc.inverse(), []
        for i in np.argsort(distance, kind="stable")[:NEAREST]:
            keyframe, points = here[i]
            T_fk = T_fw @ keyframe.T_wc
            neighbour = Neighbour(keyframe, T_fk, float(is_expected(points, T_fk, camera).mean()))
            if neighbour.overlap >= CROWD_OVERLAP and neighbour.roll_rad < ROLL_RAD:
                found.append(neighbour)
        return sorted(found, key=lambda neighbour: -neighbour.likeness)


def sketch(keyframe: Keyframe, config: TrackingConfig) -> Array:
    """[M, 3] some points of a keyframe, in its camera frame."""
    known = keyframe.pointmap.is_known(config.known_sigma)
    return sample(keyframe.pointmap, known, SKETCH_POINTS)[2]
