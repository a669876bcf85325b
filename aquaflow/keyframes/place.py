"""What a finished dive keeps of a keyframe, so that its place can be recognised another day.

Descriptors are kept in four bits for each number. They are only ever compared after the square
root of each number's share in the whole was taken (RootSIFT), and it is that root which is rounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Float, Keypoints

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

LEVELS = 15
"""Largest code of a descriptor's number: half a byte."""
LARGEST_ROOT = 0.375
"""Root of a number's share that gets the largest code; beyond it is cut off. SIFT cuts its numbers
at 0.2 of the length (D. Lowe, IJCV 2004); of a frame each of the reef and Curasao clips none is
beyond. The rounding moves a descriptor of length 1 by 0.075 there (median, measured)."""
PIXEL_STEPS = 1 << 16
"""Steps of a coordinate over the side of the picture: 0.007 px at 480 px."""
LARGEST_HALF = 6e4
"""Near the largest number that float16 holds."""


@dataclass(frozen=True)
class KeypointDepths:
    """Keypoints of a picture, and what is known of how far away their points are."""

    camera: CameraModel
    keypoints: Keypoints
    rho: Array
    """[M] 1 / z in the unit of the keyframe; 0 where unknown."""
    variance: Array
    """[M] variance of ``rho``."""

    def is_known(
        self,
        relative_sigma: float,
    ) -> npt.NDArray[np.bool_]:
        """[M] keypoints whose inverse depth is known to better than ``relative_sigma``."""
        return (self.rho > 1e-6) & (self.variance < (relative_sigma * self.rho) ** 2)

    def points(self) -> Array:
        """[M, 3] in the camera's frame, in the unit of the keyframe; NaN where unknown."""
        rays = self.camera.unproject(self.keypoints.pixels.astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.rho[:, None] > 1e-6, rays / self.rho[:, None], np.nan)


def depths_at(keypoints: Keypoints, pointmap: Pointmap) -> KeypointDepths:
    """What the ``pointmap`` of their picture knows of the keypoints' depths."""
    pixels = keypoints.pixels
    rho, variance = at_pixels(pointmap.rho, pixels), at_pixels(pointmap.variance, pixels)
    return KeypointDepths(pointmap.camera, keypoints, rho, variance)


@dataclass(frozen=True)
class KeyframePlace:
    """A keyframe of a finished dive without its picture."""

    number: int
    """Among the dive's keyframes."""
    frame_index: int
    sub_map: int
    t_ns: int
    T_mc: Sim3
    """Camera to m, the world of the sub-map's ``map.aqf``; its scale takes the keyframe's unit to
    that of m."""
    camera: CameraModel


def pack(seen: KeypointDepths) -> npt.NDArray[np.void]:
    """[] one structured number: pixels, inverse depths, their sigmas, descriptors."""
    count, dimension = seen.keypoints.descriptors.shape
    if dimension % 2:
        raise ValueError("a descriptor with an odd number of dimensions is not kept")
    row = np.zeros((), features_dtype(count, dimension))
    side = (seen.camera.width, seen.camera.height)
    steps = np.floor(seen.keypoints.pixels / side * PIXEL_STEPS)
    row["pixels"] = np.clip(steps, 0, PIXEL_STEPS - 1)
    known = (seen.rho > 1e-6) & (seen.variance < UNKNOWN_VARIANCE)
    row["rho"] = np.where(known, seen.rho, 0.0)
    sigma = np.sqrt(np.maximum(seen.variance, 0.0)) / np.where(known, seen.rho, 1.0)
    row["sigma"] = np.where(known, np.minimum(sigma, LARGEST_HALF), 0.0)
    row["descriptors"] = _codes(seen.keypoints.descriptors)
    return row


def unpack(
    row: npt.NDArray[np.void],  # [] as from packed
    camera: CameraModel,
) -> KeypointDepths:
    """What :func:`pack` took apart, rounded.

    Raises:
        DamagedError: it holds numbers that it cannot hold.
    """
    names = ("pixels", "rho", "sigma", "descriptors")
    if row.shape != () or row.dtype.names != names:
        raise DamagedError("it is not what a keyframe keeps")
    count, half = row["descriptors"].shape
    if row.dtype != features_dtype(count, 2 * half):
        raise DamagedError("it is not what a keyframe keeps")
    rho, sigma = row["rho"].astype(np.float64), row["sigma"].astype(np.float64)
    if not (np.isfinite(rho).all() and np.isfinite(sigma).all()):
        raise DamagedError("a depth is not finite")
    if (rho < 0.0).any() or (sigma < 0.0).any():
        raise DamagedError("a depth is negative")
    pixels = (row["pixels"] + 0.5) / PIXEL_STEPS * (camera.width, camera.height)
    variance = np.where(rho > 0.0, (sigma * rho) ** 2, UNKNOWN_VARIANCE)
    keypoints = Keypoints(pixels.astype(np.float32), _descriptors(row["descriptors"]))
    return KeypointDepths(camera, keypoints, rho, variance)


def features_dtype(count: int, dimension: int) -> np.dtype[np.void]:
    """Of ``count`` keypoints whose descriptors have ``dimension`` numbers, each kind together."""
    return np.dtype(
        [
            ("pixels", "<u2", (count, 2)),
            ("rho", "<f4", (count,)),
            ("sigma", "<f2", (count,)),
            ("descriptors", "u1", (count, dimension // 2)),
        ]
    )


def _codes(
    descriptors: Float,  # [M, d] not negative
) -> Bytes:
    """[M, d / 2]"""
    if (descriptors < 0.0).any():
        raise ValueError("a descriptor with negative numbers is not kept")
    share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    codes = np.rint(np.sqrt(share) * (LEVELS / LARGEST_ROOT))
    codes = np.minimum(codes, LEVELS).astype(np.uint8)
    return np.asarray((codes[:, ::2] << 4) | codes[:, 1::2], dtype=np.uint8)


def _descriptors(
    codes: Bytes,  # [M, d / 2]
) -> Float:
    """[M, d] shares, of which only the ratios count."""
    count, half = codes.shape
    both = np.stack([codes >> 4, codes & LEVELS], axis=-1).reshape(count, 2 * half)
    return np.asarray((both * np.float32(LARGEST_ROOT / LEVELS)) ** 2, dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Inverse depths of a keyframe's pixels: triangulated, and what a prior knows of them.

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
