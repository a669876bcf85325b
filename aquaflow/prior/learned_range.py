"""Points where parallax sees nothing: the network's range, with its own, large variance.

Triangulated points are some twenty times as exact (docs/measurements.md#compact-prior), so the
network only fills what they leave, and gives them its unit where that is the metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float

LEAST_VARIANCE = 1e-4
"""Of the logarithm of a range: no network knows it better than to a hundredth."""
MOST_LOG = 30.0
"""Logarithm beyond which a range or variance is nonsense; e^30 m is still a number."""
LEAST_COMMON = 20
"""Pixels known to both below which their scales are not compared."""


@dataclass(frozen=True)
class LearnedRange:
    """What a network says of the distances in a picture; cells cover it evenly."""

    log_range: Float
    """[rows, columns] natural logarithm"""
    variance: Float
    """[rows, columns] of log_range"""
    metric: bool
    """True if ranges are metres, and not up to a factor."""


def filled(
    X: Float,  # [H, W, 3] NaN where unknown
    Q: Float,  # [H, W] 0 where unknown
    camera: CameraModel,
    learned: LearnedRange,
) -> tuple[Float, Float]:
    """X and Q with the learned range where they were unknown, in one unit.

    The unit is the network's if that is the metre, else the triangulation's; without common pixels
    the two units cannot be compared, and the network's range is used alone.
    """
    height, width = Q.shape
    log_range = _spread(learned.log_range, height, width)
    log_variance = _spread(np.log(np.maximum(learned.variance, LEAST_VARIANCE)), height, width)
    known, factor = Q > 0.0, 0.0
    if known.sum() >= LEAST_COMMON:
        distance = np.linalg.norm(X[known].astype(np.float64), axis=-1)
        factor = float(np.median(np.log(distance) - log_range[known]))
    else:
        known = np.zeros_like(known)
    if learned.metric:
        X = (X * np.exp(-factor)).astype(np.float32)
    else:
        log_range = log_range + factor
    rays = camera.unproject(camera.pixel_centres())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    guessed = rays * np.exp(np.clip(log_range, -MOST_LOG, MOST_LOG))[..., None]
    X = np.where(known[..., None], X, guessed).astype(np.float32)
    return X, np.where(known, Q, np.exp(-log_variance)).astype(np.float32)


def _spread(
    cells: npt.NDArray[np.floating],  # [rows, columns]
    height: int,
    width: int,
) -> npt.NDArray[np.float64]:
    """[height, width] linear between the cells' centres; what is no number counts as nonsense."""
    finite = np.nan_to_num(cells, nan=MOST_LOG, posinf=MOST_LOG, neginf=-MOST_LOG)
    finite = np.clip(finite, -MOST_LOG, MOST_LOG).astype(np.float32)
    return np.asarray(cv2.resize(finite, (width, height)), dtype=np.float64)
