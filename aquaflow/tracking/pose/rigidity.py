"""Are the matches of a frame those of one rigid scene, whatever the keyframe's depths say? What
floats in front of the scene moves as it likes; wrong depths leave the matches as they are."""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.two_view import pose_candidates
from aquaflow.prior.contract import PairGeometry

SAMPLED = 400
"""Matches that the two-view pose is estimated from: some 5 ms."""


def rigid_share(
    pair: PairGeometry,
    camera_k: CameraModel,
    camera: CameraModel,
) -> float:
    """Share of the valid matches that one motion of the camera explains; 0 of too few."""
    rows, columns = np.nonzero(pair.valid)
    step = max(1, -(-len(rows) // SAMPLED))
    rows, columns = rows[::step], columns[::step]
    pixels_k = np.stack([columns + 0.5, rows + 0.5], -1)
    pixels = pair.matches[rows, columns].astype(np.float64)
    candidates = pose_candidates(pixels_k, pixels, camera_k, camera)
    return candidates[0].support if candidates else 0.0
