"""Inverse depths of a keyframe's pixels: triangulated, and what a prior knows of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

UNKNOWN_VARIANCE = 1e6
"""Variance of an inverse depth that nothing has been measured about."""


@dataclass(frozen=True)
class LearnedDepths:
    """What a prior knows of a keyframe's depths without parallax, in the keyframe's unit."""

    rho: Array
    """[H, W] 1 / z; 0 where unknown."""
    variance: Array
    """[H, W] variance of ``rho``."""
    log_scale: float
    """Logarithm of the keyframe's unit over the prior's."""
    log_scale_sigma: float


@dataclass
class Pointmap:
    """Inverse depth of every pixel with its variance, in the camera frame (paper: X_k^k with Q)."""

    camera: CameraModel
    rho: Array
    """[H, W] 1 / z, triangulated; 0 where unknown."""
    variance: Array
    """[H, W] variance of ``rho``."""
    fused: int = 0
    """Frames whose depths were fused into it."""
    learned: LearnedDepths | None = None

    @staticmethod
    def unknown(camera: CameraModel) -> Pointmap:
        """One that knows nothing of any pixel."""
        shape = (camera.height, camera.width)
        return Pointmap(camera, np.zeros(shape), np.full(shape, UNKNOWN_VARIANCE))

    def is_known(
        self,
        relative_sigma: float,
    ) -> Mask:
        """[H, W] pixels whose inverse depth is known to better than ``relative_sigma``."""
        return (self.rho > 1e-6) & (self.variance < (relative_sigma * self.rho) ** 2)

    def complete(
        self,
        relative_sigma: float,
    ) -> Pointmap:
        """Itself, or a copy with the learned depths wherever it does not know its own to
        ``relative_sigma``."""
        learned = self.learned
        if learned is None:
            return self
        instead = (learned.rho > 0.0) & ~self.is_known(relative_sigma)
        rho = np.where(instead, learned.rho, self.rho)
        variance = np.where(instead, learned.variance, self.variance)
        return replace(self, rho=rho, variance=variance, learned=None)

    def not_learned(
        self,
        pixels: Mask,  # [H, W]
    ) -> Pointmap:
        """The same, but of ``pixels`` nothing is learned."""
        if self.learned is None:
            return self
        rho = np.where(pixels, 0.0, self.learned.rho)
        return replace(self, learned=replace(self.learned, rho=rho))

    @property
    def Q(self) -> Array:
        """[H, W] point confidence: 1 / relative variance; 0 where unknown."""
        known = (self.rho > 1e-6) & (self.variance < UNKNOWN_VARIANCE)
        return np.where(known, self.rho**2 / np.maximum(self.variance, 1e-12), 0.0)

    def points(self) -> Array:
        """[H, W, 3] pointmap in the camera frame; NaN where unknown."""
        rays = self.camera.unproject(self.camera.pixel_centres())
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.rho[..., None] > 1e-6, rays / self.rho[..., None], np.nan)

    def copy(self) -> Pointmap:
        """With arrays of its own; learned depths are never changed in place."""
        return replace(self, rho=self.rho.copy(), variance=self.variance.copy())
