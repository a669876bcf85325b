"""A frame's own points, as the prior has them, for residuals between pointmaps (paper, Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.pixels import at_pixels
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import PairGeometry
from aquaflow.tracking.learned.scaling import learned_depth

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OwnPoints:
    """Points of a frame at given pixels, in the keyframe's unit."""

    points: Array
    """[M, 3] in the frame's camera; NaN where unknown"""
    rho_variance: Array
    """[M] of their inverse depths"""


def own_points(
    pointmap: Pointmap,
    pair: PairGeometry,
    pixels: Array,  # [M, 2] px in the frame
    camera: CameraModel,
    known_sigma: float,
) -> OwnPoints | None:
    """X of the frame, seen by ``camera``, at ``pixels``. The prior has both pictures' points in one
    unit, and the keyframe's ``pointmap`` says which; None without ranges, or without that unit."""
    if pair.range_unit != "shared":
        return None
    if pair.X_a is None or pair.Q_a is None or pair.X_b is None or pair.Q_b is None:
        return None
    keyframe = learned_depth(pointmap, pair.X_a, pair.Q_a, known_sigma)
    if keyframe is None:
        return None
    Q = at_pixels(pair.Q_b, pixels).astype(np.float64)
    z = at_pixels(pair.X_b[..., 2], pixels) * np.exp(keyframe.log_scale)
    known = np.isfinite(z) & (z > 0.0) & (Q > 0.0)
    rho = 1.0 / np.where(known, z, 1.0)
    rays = camera.unproject(pixels)
    variance = keyframe.honesty**2 / np.where(known, Q, 1.0) * rho**2
    return OwnPoints(np.where(known[:, None], rays * z[:, None], np.nan), variance)
