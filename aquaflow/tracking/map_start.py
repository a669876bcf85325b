"""The start of a map: frames wait until a two-view geometry is found, for one reference at a
time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.frames import Wait, WaitingFrames
from aquaflow.tracking.initialisation.initialiser import Initialiser, calibrate, fused_pointmap
from aquaflow.tracking.learned import LearnedDepth, add_learned, agreement, unscaled_depth
from aquaflow.tracking.pose.matcher import pose_problem
from aquaflow.tracking.pose.solver import PoseEstimate, solve_pose
from aquaflow.types import Frame

MOST_FOLLOWED = 4
"""Frames by which a live dive goes on from its first keyframe. The newest shares the least with it:
posed by it alone, one over a flat seabed was 0.65 units off, and all after it
(notes/2026-11-tracking.md#live-start)."""


@dataclass(frozen=True)
class PosedFrame:
    """A frame of the initialisation: its pose against the reference and its matches; without them
    one that the initialisation had left out."""

    frame: Frame
    T_fk: Sim3 | None = None
    pair: PairGeometry | None = None


@dataclass(frozen=True)
class NewMap:
    """The first keyframe of a map, and the frames after it that are followed from there."""

    reference: Frame
    encoding: Encoding
    """Of the reference, with ``camera``."""
    pointmap: Pointmap
    camera: CameraModel
    """With the refined focal length, where it was unknown."""
    focal_sigma: float
    posed: list[PosedFrame]
    T_waiting: Sim3 = field(default_factory=Sim3.identity)
    """T_fk about which the newest of the frames that still wait is looked for."""


class MapStart:
    """Collects frames matched to a reference until their geometry is found."""

    def __init__(
        self,
        prior: Prior,
        config: TrackingConfig,
        waiting: WaitingFrames,
        failures: Failures,
        in_step: bool,
    ) -> None:
        """A map that is not made ``in_step`` with the frames goes on by a few of them up to the
        newest one: the others wait for idle time."""
        self._prior, self._config = prior, config
        self._waiting, self._failures, self._in_step = waiting, failures, in_step
        self._initialiser: Initialiser | None = None

    def add(self, frame: Frame, encoding: Encoding) -> bool:
        """Match a frame to the reference; False if that fails, or if there is none."""
        initialiser, matched = self._initialiser, False
        if initialiser is None:
            return False
        with self._failures.contain("initialisation", frame.index):
            matched = initialiser.add(frame, encoding)
        if matched:
            self._waiting.put([frame], Wait.INITIALISING)
            self._waiting.put(initialiser.thin(), Wait.THINNED)
        return matched

    @property
    def ready(self) -> bool:
        """True if :meth:`solve` is worth an attempt."""
        return self._initialiser is not None and self._initialiser.ready

    @property
    def turned_back(self) -> bool:
        """True if the newest frame is the better reference: the camera has turned back
        (:attr:`Initialiser.turned_back`), or matches to this one contradict each other."""
        initialiser = self._initialiser
        return initialiser is not None and (initialiser.turned_back or initialiser.contradicted)

    def solve(self) -> NewMap | None:
        """Initialise a map from the waiting frames; None if no geometry is good enough."""
        initialiser, started = self._initialiser, None
        if initialiser is None or not initialiser.waiting:
            return None
        with self._failures.contain("initialisation", initialiser.frame.index):
            started = self._solve(initialiser)
        return self._take_started(started)

    def begin_learned(self) -> NewMap | None:
        """A map from the reference and the picture after it, by the prior's ranges; None where it
        knows none, or not well enough (docs/prior.md#start)."""
        initialiser, started = self._initialiser, None
        if initialiser is None or len(initialiser.waiting) != 1:
            return None
        with self._failures.contain("learned start", initialiser.frame.index):
            started = self._begin_map(initialiser)
        return self._take_started(started)

    def _begin_map(self, initialiser: Initialiser) -> NewMap | None:
        reference, second = initialiser.frame, initialiser.waiting[0]
        camera = initialiser.reference.camera
        found = learned_start(second.pair, camera, self._config)
        if found is None:
            return None
        posed = [PosedFrame(second.frame, found.T_fk, second.pair)]
        return NewMap(reference, initialiser.reference, found.pointmap, camera, 0.0, posed)

    def _take_started(self, started: NewMap | None) -> NewMap | None:
        """The frames of a map that starts are in hand, and no reference is waited for."""
        if started is not None:
            frames = [started.reference, *(posed.frame for posed in started.posed)]
            self._waiting.put(frames, Wait.IN_HAND)
            self.end()
        return started

    def _solve(self, initialiser: Initialiser) -> NewMap | None:
        solution = initialiser.solve()
        if solution is None:
            return None
        reference, camera = initialiser.frame, calibrate(solution.camera)
        encoding = self._prior.encode(reference.image, camera, reference.mask)
        pointmap = fused_pointmap(solution, camera, self._config.sigma_px)
        pair = max(solution.waiting, key=lambda waiting: waiting.parallax_px).pair
        config = self._config
        known, unit = config.known_sigma, pair.range_unit
        add_learned(pointmap, pair.X_a, pair.Q_a, known, config.learned, unit)
        posed = [
            PosedFrame(waiting.frame, T, waiting.pair)
            for waiting, T in zip(solution.waiting, solution.T, strict=True)
        ]
        start = NewMap(reference, encoding, pointmap, camera, solution.focal_sigma, posed)
        counted = {waiting.frame.index for waiting in solution.waiting}
        unsure = [each.frame for each in initialiser.waiting if each.frame.index not in counted]
        self._waiting.put(unsure, Wait.THINNED)
        if not self._in_step:
            step = -(-len(posed) // MOST_FOLLOWED)
            return replace(start, posed=posed[::-step][::-1], T_waiting=solution.T[-1])
        thinned = [PosedFrame(frame) for frame in self._waiting.of(Wait.THINNED)]
        in_order = sorted([*posed, *thinned], key=lambda each: each.frame.index)
        return replace(start, posed=in_order)

    def restart(self, frame: Frame, encoding: Encoding) -> None:
        """Use ``frame`` as the reference from now on."""
        self.end()
        self._initialiser = Initialiser(frame, encoding, self._prior, self._config.initialisation)
        self._waiting.put([frame], Wait.INITIALISING)

    def end(self) -> None:
        """Frames that still wait for a geometry wait for a keyframe instead."""
        self._initialiser = None
        self._waiting.move(Wait.THINNED, Wait.FOR_A_KEYFRAME)
        self._waiting.move(Wait.INITIALISING, Wait.FOR_A_KEYFRAME)


# --------------------------------------------------------------------------------------------------
# The first map from one pair of pictures, by what a prior knows of their ranges (paper, Sec. 3.2).
#
# Two pictures with hardly any parallax have no geometry of their own. Where the prior's ranges are
# certain enough, and both pictures' agree, they are the first map; triangulation corrects it once
# the camera has moved.

MATCHES = 2000
"""Of the pair, that its pose is solved from."""


@dataclass(frozen=True)
class LearnedStart:
    """The reference's pointmap, its median depth 1, and the second picture's pose."""

    pointmap: Pointmap
    T_fk: Sim3
    """Reference to second picture."""


def learned_start(
    pair: PairGeometry, camera: CameraModel, config: TrackingConfig
) -> LearnedStart | None:
    """A map from ``pair``; None where the prior knows no ranges, or only up to a shift, states that
    they are less certain than ``learned.start_sigma``, or contradicts itself or the matches."""
    if not (config.learned.start and camera.calibrated) or pair.range_unit == "affine":
        return None
    if pair.X_a is None or pair.Q_a is None or pair.X_b is None or pair.Q_b is None:
        return None
    depth_a = unscaled_depth(camera, pair.X_a, pair.Q_a)
    depth_b = unscaled_depth(camera, pair.X_b, pair.Q_b)
    if depth_a is None or depth_b is None or _sigma(depth_a) > config.learned.start_sigma:
        return None
    estimate, honesty = _pose(pair, camera, depth_a, depth_b, config)
    if estimate is None or estimate.inlier_share < config.initialisation.min_explained:
        return None
    honest = unscaled_depth(camera, pair.X_a, pair.Q_a, max(honesty, 1.0))
    if honest is None or _sigma(honest) > config.learned.start_sigma:
        return None
    return LearnedStart(replace(Pointmap.unknown(camera), learned=honest.kept), estimate.T)


def _sigma(depth: LearnedDepth) -> float:
    """Median relative sigma."""
    return float(np.sqrt(np.median(depth.variance[depth.known])))


def _pose(
    pair: PairGeometry,
    camera: CameraModel,
    depth_a: LearnedDepth,
    depth_b: LearnedDepth,
    config: TrackingConfig,
) -> tuple[PoseEstimate | None, float]:
    """The second picture's pose, and by how much both pictures' ranges differ, in stated errors."""
    rows, columns = np.nonzero(pair.valid & depth_a.known)
    if len(rows) < config.min_matches:
        return None, 1.0
    step = -(-len(rows) // MATCHES)
    rows, columns = rows[::step], columns[::step]
    pointmap = replace(Pointmap.unknown(camera), learned=depth_a.kept).complete(1.0)
    pixels_a = np.stack([columns + 0.5, rows + 0.5], -1)
    pixels_b = pair.matches[rows, columns].astype(np.float64)
    weights = pair.C[rows, columns].astype(np.float64)
    problem = pose_problem(pointmap, pixels_a, pixels_b, camera, config.sigma_px, weights)
    estimate = solve_pose(problem, Sim3.identity())
    if estimate is None:
        return None, 1.0
    z_in_b = estimate.T.apply(problem.points)[:, 2]
    return estimate, agreement(depth_a, depth_b, z_in_b, pixels_a, pixels_b)
