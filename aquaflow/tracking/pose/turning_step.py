"""A step into a part of the scene whose depth the keyframe does not know yet.

A camera that turns by half its view between two pictures shows, in the second one, what the first
one has just come to see: nothing there has a depth that a pose could be solved from. Matches alone
give the rotation and the direction of the step; its length comes from the few points that are known
or, without any, from the step before.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import (
    MIN_MATCHES,
    pose_candidates,
    rotation_compensated_parallax_px,
)
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Mask, PairGeometry

Array = npt.NDArray[np.float64]

MATCHES = 1500
"""Matches that the two-view pose is estimated from."""
LEAST_PARALLAX_PX = 1.5
"""What the best pure rotation leaves unexplained: less, and there is no direction to find."""
LEAST_SUPPORT = 0.6
"""Matches that triangulate well under the pose; of unrelated pictures a third do."""
AS_GOOD = 0.9
"""Support over the best one's of a pose that may be the right one too, as over a plane."""
KNOWN_POINTS = 30
"""Points of known depth that a length is taken from."""
LENGTH_SPREAD = 0.3
"""Median absolute deviation over median of the lengths that these points ask for."""
MOST_CHANGE = 3.0
"""Ratio of two steps in a row."""


def turning_step(
    pointmap: Pointmap,
    pair: PairGeometry,
    known: Mask,  # [H, W] pixels of the keyframe whose depth is good
    camera: CameraModel,
    predicted: Sim3,
) -> Sim3 | None:
    """T_fk in the keyframe's unit, from matches; ``predicted`` is where the motion before leads to.

    None where too few matches agree on a pose, or nothing says how long the step was.
    """
    pixels_k, pixels = _matches(pair, pair.valid)
    if len(pixels) < MIN_MATCHES:
        return None
    if rotation_compensated_parallax_px(pixels_k, pixels, camera) < LEAST_PARALLAX_PX:
        return None
    candidates = pose_candidates(pixels_k, pixels, pointmap.camera, camera)
    if not candidates or candidates[0].support < LEAST_SUPPORT:
        return None
    likely = [c.T_ba for c in candidates if c.support >= AS_GOOD * candidates[0].support]
    T = max(likely, key=lambda each: float(each.t @ predicted.t))
    length = _length(pointmap, *_matches(pair, pair.valid & known), camera, T)
    usual = float(np.linalg.norm(predicted.t))
    if length is None:
        length = usual
    elif usual > 0.0 and not 1.0 / MOST_CHANGE < length / usual < MOST_CHANGE:
        return None
    return Sim3(T.R, length * T.t) if length > 0.0 else None


def _matches(
    pair: PairGeometry,
    which: Mask,  # [H, W]
) -> tuple[Array, Array]:
    """[M, 2] px each: about ``MATCHES`` pixels of the keyframe at most, evenly taken, and where
    they are seen."""
    rows, columns = np.nonzero(which)
    step = max(1, len(rows) // MATCHES)
    rows, columns = rows[::step], columns[::step]
    return np.stack([columns + 0.5, rows + 0.5], -1), pair.matches[rows, columns].astype(np.float64)


def _length(
    pointmap: Pointmap,
    pixels_k: Array,  # [M, 2] px, of known depth
    pixels: Array,  # [M, 2] px, where they are seen
    camera: CameraModel,
    T: Sim3,
) -> float | None:
    """How long the step along T.t is by the known points; None where they do not agree."""
    if len(pixels_k) < KNOWN_POINTS:
        return None
    points = pointmap.camera.unproject(pixels_k) / at_pixels(pointmap.rho, pixels_k)[:, None]
    rays = camera.unproject(pixels)
    # rays x (R points + length t) = 0, by least squares for each point.
    turned, along = np.cross(rays, points @ T.R.T), np.cross(rays, T.t)
    strength = (along * along).sum(-1)
    lengths = -(turned * along).sum(-1) / np.maximum(strength, 1e-12)
    length = float(np.median(lengths))
    spread = float(np.median(np.abs(lengths - length)))
    return length if length > 0.0 and spread < LENGTH_SPREAD * length else None
