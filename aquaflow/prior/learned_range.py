"""Ranges that a network gives without parallax, as the contract's pointmap X and confidence Q."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, Mask

LEAST_VARIANCE = 1e-4
"""Of the logarithm of a range: no network knows it better than to a hundredth."""
MOST_LOG = 30.0
"""Logarithm beyond which a range or variance is nonsense; e^30 m is still a number."""

LEAST_WEIGHT = 0.25
"""Bilinear weight of the cells with sound numbers from which a pixel is known: its own cell's."""


@dataclass(frozen=True)
class LearnedRange:
    """What a network says of the distances in a picture; cells cover it evenly."""

    log_range: Float
    """[rows, columns] natural logarithm; NaN where it does not know"""
    variance: Float
    """[rows, columns] of log_range"""

    def pointmap(self, camera: CameraModel) -> tuple[Float, Float]:
        """X [H, W, 3] in the camera's frame, and Q [H, W]: linear between the cells' centres that
        have sound numbers. Where there are none around, NaN and 0."""
        height, width = camera.height, camera.width
        sound = np.isfinite(self.log_range) & np.isfinite(self.variance)
        sound &= (np.abs(np.where(sound, self.log_range, 0.0)) < MOST_LOG) & (self.variance > 0.0)
        variance = np.clip(self.variance, LEAST_VARIANCE, np.exp(MOST_LOG))
        weight = spread_over(sound, height, width).astype(np.float64)
        known = weight > LEAST_WEIGHT
        weight = np.where(known, weight, 1.0)
        log_range = spread_over(np.where(sound, self.log_range, 0.0), height, width) / weight
        log_variance = spread_over(np.log(np.where(sound, variance, 1.0)), height, width) / weight
        Q = np.exp(-np.where(known, log_variance, 0.0))
        rays = camera.unproject(camera.pixel_centres())
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        distance = np.exp(np.where(known, log_range, 0.0))
        X = np.where(known[..., None], rays * distance[..., None], np.nan)
        return X.astype(np.float32), np.where(known, Q, 0.0).astype(np.float32)


def cell_rays(camera: CameraModel, rows: int, columns: int) -> Float:
    """[rows, columns, 2] x / z and y / z of the centres of cells that cover the picture."""
    v, u = np.mgrid[:rows, :columns] + 0.5
    pixels = np.stack([u * camera.width / columns, v * camera.height / rows], -1)
    return camera.unproject(pixels)[..., :2].astype(np.float32)


def spread_over(
    cells: npt.NDArray[np.floating] | Mask,  # [rows, columns]
    height: int,
    width: int,
) -> Float:
    """[height, width] linear between the cells' centres."""
    return np.asarray(cv2.resize(cells.astype(np.float32), (width, height)), dtype=np.float32)
