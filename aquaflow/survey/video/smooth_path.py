"""A smooth way of a camera along the poses of a dive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.float64]

SAMPLES_PER_KNOT = 8
"""Places along the path between two knots of the splines, over which it is smoothed."""
SMOOTHING_KNOTS = 0.5
"""Standard deviation of the smoothing, in distances of knots: a vehicle's jitter is gone, and a
turn that takes two knots stays."""


def smooth_path(poses: Sequence[Sim3], count: int, knots: int) -> list[Sim3]:
    """``count`` poses along ``poses`` (T_wc), at an even pace of moving and turning together, where
    a radian of turn counts as a unit of length: the median depth of the first picture.

    ``knots`` is the number of poses that the splines pass through: fewer are smoother.
    """
    places = np.array([pose.t for pose in poses])
    turns = Rotation.from_matrix([pose.R for pose in poses])
    way = _way(places, turns)
    if way[-1] <= 0.0:
        return [Sim3(turns[0].as_matrix(), places[0])] * count
    moved = np.concatenate([[True], np.diff(way) > 0.0])
    way, places, turns = way[moved], places[moved], turns[np.flatnonzero(moved)]
    dense = np.linspace(0.0, way[-1], knots * SAMPLES_PER_KNOT)
    centres = np.stack([np.interp(dense, way, axis) for axis in places.T], axis=1)
    quaternions = _continuous(_slerped(way, turns, dense).as_quat())
    sigma = SMOOTHING_KNOTS * SAMPLES_PER_KNOT
    centres = gaussian_filter1d(centres, sigma, axis=0, mode="nearest")
    quaternions = gaussian_filter1d(quaternions, sigma, axis=0, mode="nearest")
    chosen = np.linspace(0, len(dense) - 1, knots).round().astype(int)
    at = np.linspace(0.0, dense[-1], count)
    new_places = CubicSpline(dense[chosen], centres[chosen])(at)
    new_turns = RotationSpline(dense[chosen], Rotation.from_quat(quaternions[chosen]))(at)
    return [Sim3(R, t) for R, t in zip(new_turns.as_matrix(), new_places, strict=True)]


def _way(
    places: Array,  # [N, 3]
    turns: Rotation,
) -> Array:
    """[N] how far it is to each pose, moving and turning."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    angles = (turns[:-1].inv() * turns[1:]).magnitude() if len(places) > 1 else np.zeros(0)
    return np.concatenate([[0.0], np.cumsum(steps + angles)])


def _slerped(
    way: Array,  # [N] increasing
    turns: Rotation,
    at: Array,  # [M]
) -> Rotation:
    from scipy.spatial.transform import Slerp

    return Slerp(way, turns)(np.clip(at, way[0], way[-1]))


def _continuous(
    quaternions: Array,  # [N, 4]
) -> Array:
    """The same rotations without jumps of sign, which would not average."""
    same = np.einsum("ni,ni->n", quaternions[:-1], quaternions[1:]) >= 0.0
    signs = np.cumprod(np.where(np.concatenate([[True], same]), 1.0, -1.0))
    return np.asarray(quaternions * signs[:, None])
