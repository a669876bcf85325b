"""A learned range in a keyframe's unit, with a variance that the keyframe's own depths confirm.

A network's ranges have a unit of their own, are off by a slope across the picture, and seldom have
the error that it states. All three are found where the keyframe's depths are triangulated: scale
and slope by robust least squares, and the factor of the error by the spread that is left. Errors of
neighbours are alike, so that however many pixels are compared, they count as few.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.pixels import at_pixels
from aquaflow.keyframes import LearnedDepths, Pointmap
from aquaflow.prior.contract import Float, Mask

Array = npt.NDArray[np.float64]

COMPARED = 4000
"""Most pixels that learned and triangulated depths are compared at."""
LEAST_COMMON = 200
"""Pixels known to both below which a unit is not found: two cells of a small picture."""
INDEPENDENT = 48
"""Errors of a network that count as independent in a picture (8 x 6 cells), as those of matches
(tracking/pose/covariance.py)."""
SLOPE_SIGMA = 0.1
"""Of the logarithm from the picture's middle to its edge: a slope of 6 degrees over a floor seen
straight down; a network that sees the floor's tilt errs by less."""
TUKEY = 4.685
"""Standard deviations beyond which a difference does not count (biweight, 95 % efficiency under
Gaussian noise): false depths lie on one side, and the unit would follow any part of them."""
ITERATIONS = 8
"""Of reweighting; each divides the remaining error by five or more."""
HONESTY = (0.5, 10.0)
"""Bounds of the factor of the stated error: a tenth of the picture may happen to fit too well."""
MAD_TO_SIGMA = 1.4826
"""Of a normal distribution."""


@dataclass(frozen=True)
class LearnedDepth:
    """Learned inverse depths in the unit of a keyframe."""

    rho: Array
    """[H, W] 1 / z; 0 where unknown"""
    variance: Array
    """[H, W] of the logarithm of ``rho``: the network's own, grown by what the comparison showed"""
    log_scale: float
    """Logarithm of the keyframe's unit over the network's, in the middle of the picture"""
    log_scale_sigma: float
    honesty: float
    """Error found over error stated."""

    @property
    def known(self) -> Mask:
        """[H, W]"""
        return self.rho > 0.0

    @property
    def kept(self) -> LearnedDepths:
        """What a pointmap keeps of it."""
        variance = np.where(self.known, self.variance, 0.0) * self.rho**2
        return LearnedDepths(self.rho, variance, self.log_scale, self.log_scale_sigma)


def learned_depth(
    pointmap: Pointmap,
    X: Float,  # [H, W, 3] in the pointmap's camera; NaN where unknown
    Q: Float,  # [H, W] 1 / relative variance; 0 where unknown
    known_sigma: float,
) -> LearnedDepth | None:
    """The learned range in the unit of ``pointmap``, by the pixels that it knows to better than
    ``known_sigma``; None if they are too few."""
    learned = _learned(X, Q)
    rows, columns = np.nonzero(learned & pointmap.known(known_sigma))
    if len(rows) < LEAST_COMMON:
        return None
    step = -(-len(rows) // COMPARED)
    rows, columns = rows[::step], columns[::step]
    rho = pointmap.rho[rows, columns]
    log_ratio = -np.log(rho * X[rows, columns, 2].astype(np.float64))
    stated = 1.0 / Q[rows, columns].astype(np.float64)
    own = pointmap.variance[rows, columns] / rho**2
    A = _positions(pointmap.camera)[rows, columns]
    found, covariance, honesty = _fitted(A, log_ratio, stated, own)
    return _applied(pointmap.camera, X, Q, learned, found, covariance, honesty)


def unscaled_depth(
    camera: CameraModel,
    X: Float,  # [H, W, 3]; NaN where unknown
    Q: Float,  # [H, W]; 0 where unknown
    honesty: float = 1.0,
) -> LearnedDepth | None:
    """The learned range in a unit that makes its median depth 1; None where nothing is known."""
    learned = _learned(X, Q)
    if learned.sum() < LEAST_COMMON:
        return None
    found = np.array([-np.log(float(np.median(X[learned][:, 2]))), 0.0, 0.0])
    return _applied(camera, X, Q, learned, found, np.zeros((3, 3)), honesty)


def agreement(
    depth_a: LearnedDepth,
    depth_b: LearnedDepth,
    z_in_b: Array,  # [M] depths of a's points in b
    pixels_a: Array,  # [M, 2] px
    pixels_b: Array,  # [M, 2] px of the same points
) -> float:
    """Difference of two pictures' learned depths at common points over the error that they state;
    what both pictures get wrong alike does not show."""
    rho_b = at_pixels(depth_b.rho, pixels_b)
    variance = at_pixels(depth_a.variance, pixels_a) + at_pixels(depth_b.variance, pixels_b)
    sound = (rho_b > 0.0) & (z_in_b > 0.0) & np.isfinite(variance) & (variance > 0.0)
    if sound.sum() < LEAST_COMMON:
        return HONESTY[1]
    log_ratio = np.log(z_in_b[sound] * rho_b[sound])
    left = (log_ratio - np.median(log_ratio)) / np.sqrt(variance[sound])
    return float(np.clip(MAD_TO_SIGMA * np.median(np.abs(left)), *HONESTY))


def _learned(
    X: Float,  # [H, W, 3]
    Q: Float,  # [H, W]
) -> Mask:
    sound = np.isfinite(X).all(-1) & np.isfinite(Q)
    return np.asarray(sound & (np.where(sound, X[..., 2], 0.0) > 0.0) & (Q > 0.0))


def _positions(camera: CameraModel) -> Array:
    """[H, W, 3]: 1, and the pixel's place from -1 to 1 across and down."""
    across = (np.arange(camera.width) + 0.5) * (2.0 / camera.width) - 1.0
    down = (np.arange(camera.height) + 0.5) * (2.0 / camera.height) - 1.0
    u, v = np.meshgrid(across, down)
    return np.stack([np.ones_like(u), u, v], -1)


def _fitted(
    A: Array,  # [M, 3]
    log_ratio: Array,  # [M]
    stated: Array,  # [M] variance that the network states
    own: Array,  # [M] relative variance of the keyframe's depth
) -> tuple[Array, Array, float]:
    """Scale and slopes [3], their covariance [3, 3], and the factor of the stated error."""
    found = np.array([float(np.median(log_ratio)), 0.0, 0.0])
    honesty, share = 1.0, min(INDEPENDENT / len(A), 1.0)
    slopes = np.diag([0.0, SLOPE_SIGMA**-2, SLOPE_SIGMA**-2])
    covariance = np.eye(3)
    for _ in range(ITERATIONS):
        left = log_ratio - A @ found
        excess = MAD_TO_SIGMA * float(np.median(np.abs(left) / np.sqrt(stated + own)))
        honesty = float(np.clip(excess, *HONESTY))
        sigma = np.sqrt(honesty**2 * stated + own)
        weight = share * np.clip(1.0 - (left / (TUKEY * sigma)) ** 2, 0.0, None) ** 2 / sigma**2
        covariance = np.linalg.inv((A.T * weight) @ A + slopes)
        found = covariance @ ((A.T * weight) @ log_ratio)
    return found, covariance, honesty


def _applied(
    camera: CameraModel,
    X: Float,  # [H, W, 3]
    Q: Float,  # [H, W]
    learned: Mask,  # [H, W]
    found: Array,  # [3] scale and slopes
    covariance: Array,  # [3, 3] of them
    honesty: float,
) -> LearnedDepth:
    A = _positions(camera)
    z = np.where(learned, X[..., 2], 1.0).astype(np.float64) * np.exp(A @ found)
    stated = 1.0 / np.where(learned, Q, 1.0).astype(np.float64)
    variance = honesty**2 * stated + ((A @ covariance) * A).sum(-1)
    return LearnedDepth(
        np.where(learned, 1.0 / z, 0.0),
        np.where(learned, variance, np.inf),
        float(found[0]),
        float(np.sqrt(covariance[0, 0])),
        honesty,
    )
