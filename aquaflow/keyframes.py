"""Keyframes and their fused pointmaps: what tracking and mapping share."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Encoding

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

UNKNOWN_VARIANCE = 1e6
"""Variance of an inverse depth that nothing has been measured about."""


@dataclass
class Pointmap:
    """Inverse depth of every pixel with its variance, in the camera frame (paper: X_k^k with Q)."""

    camera: CameraModel
    rho: Array
    """[H, W] 1 / z; 0 where unknown."""
    variance: Array
    """[H, W] variance of ``rho``."""

    @staticmethod
    def unknown(camera: CameraModel) -> Pointmap:
        shape = (camera.height, camera.width)
        return Pointmap(camera, np.zeros(shape), np.full(shape, UNKNOWN_VARIANCE))

    def known(
        self,
        relative_sigma: float,
    ) -> Mask:
        """[H, W] pixels whose inverse depth is known to better than ``relative_sigma``."""
        return (self.rho > 1e-6) & (self.variance < (relative_sigma * self.rho) ** 2)

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
        return Pointmap(self.camera, self.rho.copy(), self.variance.copy())


@dataclass
class Keyframe:
    """A frame that others are tracked against."""

    number: int
    """Position in the store."""
    frame_index: int
    t_ns: int
    encoding: Encoding
    T_wc: Sim3
    pointmap: Pointmap
    sub_map: int


@dataclass
class KeyframeStore:
    """All keyframes of a dive, in the order of their making."""

    keyframes: list[Keyframe] = field(default_factory=list)

    def add(
        self,
        frame_index: int,
        t_ns: int,
        encoding: Encoding,
        T_wc: Sim3,
        pointmap: Pointmap,
        sub_map: int,
    ) -> Keyframe:
        number = len(self.keyframes)
        keyframe = Keyframe(number, frame_index, t_ns, encoding, T_wc, pointmap, sub_map)
        self.keyframes.append(keyframe)
        return keyframe

    def __len__(self) -> int:
        return len(self.keyframes)

    def __getitem__(self, number: int) -> Keyframe:
        return self.keyframes[number]
