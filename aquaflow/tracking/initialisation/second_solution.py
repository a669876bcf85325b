"""The second solution of a map's start: when its first keyframe is left, its depths and the poses
of the frames that see it from furthest are solved once more, together.

Tracking solves poses at given depths, and depths at given poses. What the start left wrong in both,
a direction of motion and the shape of depths that goes with it, each hands to the other: it stays,
however much parallax there is, and every later keyframe inherits it
(notes/2026-11-tracking.md#second-solution).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import MIN_MATCHES, MIN_RHO, triangulate
from aquaflow.keyframes import Keyframe
from aquaflow.tracking.frames import Tracked
from aquaflow.tracking.initialisation.bundle import Bundle, adjust
from aquaflow.tracking.initialisation.initialiser import SURE, WIDE, grid_samples, match_weights
from aquaflow.tracking.pose.matcher import Matched

Array = npt.NDArray[np.float64]

POINTS = 2600
"""Samples of the keyframe, of which the widest frames still match a sixth surely."""
LEAST_VIEWS, MOST_VIEWS = 3, 6
"""Wide frames that are solved together. With all that are as wide, 10 to 15, the direction of
motion comes out within 0.05 degrees of theirs."""
ROUNDS, OUTLIER = 3, 5.0
"""Of fitting the change of depths; samples that are left further off than so many medians are of
wrong matches."""
STEP = 1e-4
"""Of numerical derivatives, in rad and in units of the keyframe: small beside any baseline."""
LEAST_BEND = 1e-3
"""Share of the strongest change of depths below which one is not told from another."""
STRAIGHT = 0.2
"""Of the largest extent of the wide frames' positions, the share below which they have none: how
poses change across a straight way is not known."""


@dataclass(frozen=True)
class WideView:
    """A frame that sees the keyframe from further away than most."""

    T_fk: Sim3
    baseline: float
    """In units of the keyframe."""
    pixels: Array
    """[P, 2] px of the samples."""
    weights: Array
    """[P]; 0 where a sample is not seen."""


@dataclass(frozen=True)
class Reshaped:
    """Depths of a keyframe that have changed together, and what that makes of poses against it: to
    first order the change of a pose is linear in where the camera is."""

    keyframe: int
    """Number of the keyframe."""
    first_after: int
    """Index of the first frame whose pose is solved against the new depths."""
    change: Array
    """[6, 3] of the left tangent of T_fk, by the camera's position in the keyframe."""

    def concerns(self, tracked: Tracked) -> bool:
        """True of a frame whose pose was solved against the old depths."""
        return tracked.keyframe == self.keyframe and tracked.frame.index < self.first_after

    def correct(self, T_kf: Sim3) -> Sim3:
        """The pose in the keyframe, against the new depths."""
        return T_kf @ Sim3.exp(np.append(-self.change @ T_kf.t, 0.0))


class SecondSolution:
    """Collects the frames that see a map's first keyframe from furthest; solves them once."""

    def __init__(self, keyframe: Keyframe, config: TrackingConfig) -> None:
        self.keyframe, self._config = keyframe, config
        self._views: list[WideView] = []
        self._rows, self._columns = grid_samples(keyframe.encoding.interesting, POINTS)

    def take(self, solved: Matched) -> None:
        """A frame that was placed against the keyframe."""
        pair, T_fk = solved.pair, solved.estimate.T.in_source_unit()
        weights = match_weights(pair, self._rows, self._columns, SURE)
        pixels = pair.matches[self._rows, self._columns].astype(np.float64)
        self._views.append(WideView(T_fk, float(np.linalg.norm(T_fk.t)), pixels, weights))
        least = WIDE * max(view.baseline for view in self._views)
        self._views = [view for view in self._views if view.baseline >= least]
        if len(self._views) > MOST_VIEWS:
            steps = np.diff([view.baseline for view in self._views[:-1]])
            del self._views[int(np.argmin(np.abs(steps))) + 1]

    def solve(self, index: int) -> Reshaped | None:
        """Give the keyframe its new depths, for frame ``index`` and those after it; None, and
        nothing has changed, where too little is known."""
        found = self._solution()
        if found is None:
            return None
        pointmap = self.keyframe.pointmap
        rows, columns = np.nonzero(pointmap.is_known(self._config.known_sigma))
        rays = pointmap.camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1))
        rho = pointmap.rho[rows, columns]
        anew = rho + changes_of_depths(rays, rho, found.T[-1], pointmap.camera) @ found.bend()
        change = change_of_poses([view.T_fk for view in self._views], found.T)
        sound = (anew > MIN_RHO) & np.isfinite(anew)
        if not (sound.any() and np.isfinite(change).all()):
            return None
        rows, columns, rho, anew = rows[sound], columns[sound], rho[sound], anew[sound]
        pointmap.rho[rows, columns] = anew
        pointmap.variance[rows, columns] *= (anew / rho) ** 2
        return Reshaped(self.keyframe.number, index, change)

    def _solution(self) -> Solved | None:
        """The wide frames' poses and the samples' depths, in units of the keyframe; None where
        there are too few frames or samples, or depths are not known from them."""
        views, (rows, columns) = self._views, (self._rows, self._columns)
        if len(views) < LEAST_VIEWS:
            return None
        pointmap = self.keyframe.pointmap
        weights = np.stack([view.weights for view in views])
        used = pointmap.is_known(self._config.known_sigma)[rows, columns]
        used &= (weights > 0.0).any(axis=0)
        if used.sum() < MIN_MATCHES:
            return None
        own = np.stack([columns + 0.5, rows + 0.5], -1)[used]
        pixels = np.stack([view.pixels for view in views])[:, used]
        rho = pointmap.rho[rows, columns][used]
        start = Bundle([view.T_fk for view in views], rho, pointmap.camera)
        result = adjust(own, pixels, weights[:, used], start)
        found = result.bundle
        if np.median(result.rho_sigma / found.rho) > self._config.initialisation.max_depth_sigma:
            return None
        unit = float(np.median(found.rho / rho))
        T = [Sim3(T.R, unit * T.t) for T in found.T]
        return Solved(T, pointmap.camera.unproject(own), rho, found.rho / unit, pointmap.camera)


@dataclass(frozen=True)
class Solved:
    """Poses and depths that were solved together, in units of the keyframe."""

    T: list[Sim3]
    """T_fk of the wide frames, the newest last."""
    rays: Array
    """[M, 3] of the samples, z = 1."""
    before: Array
    """[M] their inverse depths as tracking has them."""
    after: Array
    """[M] as solved."""
    camera: CameraModel

    def bend(self) -> Array:
        """[6] of the pose that makes of the depths before those after: the two differ by noise, and
        by this. The depths before are the mean of more matches, and keep their noise."""
        basis = changes_of_depths(self.rays, self.before, self.T[-1], self.camera)
        basis, change = basis / self.before[:, None], self.after / self.before - 1.0
        used, bend = np.ones(len(change), bool), np.zeros(6)
        for _ in range(ROUNDS):
            bend = np.linalg.pinv(basis[used], rcond=LEAST_BEND) @ change[used]
            left = np.abs(change - basis @ bend)
            used = left < OUTLIER * np.median(left) + 1e-9
        return np.asarray(bend)


def changes_of_depths(
    rays: Array,  # [M, 3] z = 1
    rho: Array,  # [M]
    T_fk: Sim3,
    camera: CameraModel,
) -> Array:
    """[M, 6] derivative of inverse depths, triangulated with a frame at ``T_fk``, by the left
    tangent of that pose; 0 where they have no parallax."""
    pixels = camera.project(T_fk.apply(rays / rho[:, None]))
    columns = []
    for axis in range(6):
        moved = [
            triangulate(rays, pixels, Sim3.exp(step * np.eye(7)[axis]) @ T_fk, camera, 1.0, rho)
            for step in (-STEP, STEP)
        ]
        slope = (moved[1].rho - moved[0].rho) / (2.0 * STEP)
        columns.append(np.where(moved[0].good & moved[1].good & np.isfinite(slope), slope, 0.0))
    return np.stack(columns, axis=-1)


def change_of_poses(before: Sequence[Sim3], after: Sequence[Sim3]) -> Array:
    """[6, 3] by which positions [3] become the left tangents that lead from poses T_fk ``before``
    to those ``after``, nearest to all."""
    positions = np.stack([T.inverse().t for T in before])
    moved = np.stack([(b @ a.inverse()).log()[:6] for a, b in zip(before, after, strict=True)])
    return np.asarray((np.linalg.pinv(positions, rcond=STRAIGHT) @ moved).T)
