"""How right the matches of one pair are, and the relative pose that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import epipolar_distances, relative_pose
from aquaflow.lab.evaluation.matching import WITHIN_PX
from aquaflow.lab.prior_bench.pair import FoundMatches, KnownPair
from aquaflow.prior.contract import Float

Errors = npt.NDArray[np.float64]

POSE_SAMPLES = 2000
"""Matches that the pose is estimated from, evenly over those found."""
WHOLLY = 0.999
"""Of the four pixels around a place: all are visible."""


@dataclass(frozen=True)
class PairFigures:
    """Of one method on one pair."""

    matches: int
    precision: float
    """Share of the matches within 2 px of the truth, or of the true epipolar line."""
    median_px: float
    """Median distance from it; NaN without a match."""
    recall: float | None
    """Share of the textured, visible pixels that have a right match; None for a sparse method, or
    where only epipolar lines are known."""
    rotation_deg: float | None
    """Error of the pose from the matches; infinite where none follows, None without a true one."""
    direction_deg: float | None
    """Of its translation's direction, likewise."""


def figures_of(pair: KnownPair, found: FoundMatches) -> PairFigures:
    """The pair's figures for the matches of one method."""
    if pair.truth is not None and pair.visible is not None:
        errors = _pixel_errors(pair, found)
    else:
        errors = _line_errors(pair, found)
    right = errors < WITHIN_PX
    known = errors[np.isfinite(errors)]
    rotation, direction = _pose_errors(pair, found)
    return PairFigures(
        len(errors),
        float(right.mean()) if len(errors) else 0.0,
        float(np.median(known)) if len(known) else math.nan,
        _recall(pair, found, right),
        rotation,
        direction,
    )


def _pixel_errors(pair: KnownPair, found: FoundMatches) -> Errors:
    """[M] px; infinite where b does not show the true match."""
    assert pair.truth is not None
    assert pair.visible is not None
    if len(found.pixels_a) == 0:
        return np.zeros(0)
    column_row = found.pixels_a.astype(np.float64) - 0.5
    there = np.stack([_at(pair.truth[..., axis], column_row) for axis in (0, 1)], -1)
    shown = _at(pair.visible.astype(np.float32), column_row) > WHOLLY
    errors = np.linalg.norm(found.pixels_b.astype(np.float64) - there, axis=-1)
    return np.where(shown, errors, np.inf)


def _at(
    field: Float,  # [H, W]
    column_row: Errors,  # [M, 2]
) -> Errors:
    """[M] bilinear values; OpenCV's remap takes 32,767 at most."""
    return np.asarray(map_coordinates(field, column_row.T[::-1], order=1, mode="nearest"))


def _line_errors(pair: KnownPair, found: FoundMatches) -> Errors:
    """[M] px from the true epipolar lines."""
    assert pair.T_ba is not None
    rays_a = pair.camera_a.unproject(found.pixels_a.astype(np.float64))
    rays_b = pair.camera_b.unproject(found.pixels_b.astype(np.float64))
    return pair.camera_b.fx * epipolar_distances(rays_a, rays_b, pair.T_ba)


def _recall(
    pair: KnownPair,
    found: FoundMatches,
    right: npt.NDArray[np.bool_],  # [M]
) -> float | None:
    if pair.visible is None or found.textured is None:
        return None
    wanted = pair.visible & found.textured
    cells = np.floor(found.pixels_a[right]).astype(int)
    hits = np.zeros_like(wanted)
    hits[cells[:, 1], cells[:, 0]] = True
    return float((hits & wanted).sum() / max(wanted.sum(), 1))


def _pose_errors(pair: KnownPair, found: FoundMatches) -> tuple[float | None, float | None]:
    """Degrees of rotation and of the translation's direction."""
    if pair.T_ba is None:
        return None, None
    step = max(1, len(found.pixels_a) // POSE_SAMPLES)
    a, b = (p[::step].astype(np.float64) for p in (found.pixels_a, found.pixels_b))
    T_ba = relative_pose(a, b, pair.camera_a, pair.camera_b)
    if T_ba is None:
        return math.inf, math.inf
    return _rotation_deg(T_ba, pair.T_ba), _direction_deg(T_ba, pair.T_ba)


def _rotation_deg(one: Sim3, other: Sim3) -> float:
    cosine = (np.trace(one.R.T @ other.R) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _direction_deg(one: Sim3, other: Sim3) -> float:
    cosine = one.t @ other.t / max(float(np.linalg.norm(one.t) * np.linalg.norm(other.t)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
