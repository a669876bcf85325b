"""A hilly scene of which a part is triangulated, and what a network makes of it."""

from __future__ import annotations

import numpy as np

from aquaflow.keyframes import Pointmap
from tests.tracking.tracking_scenes import CAMERA, depth_map

KNOWN_SIGMA = 0.15
TRUTH = depth_map(CAMERA, flat=False)


def measured(share: float = 0.5, sigma: float = 0.01) -> Pointmap:
    """The left part of the scene, triangulated."""
    pointmap = Pointmap.unknown(CAMERA)
    width = round(share * CAMERA.width)
    pointmap.rho[:, :width] = 1.0 / TRUTH[:, :width]
    pointmap.variance[:, :width] = (sigma * pointmap.rho[:, :width]) ** 2
    return pointmap


def network(
    unit: float = 3.0, sigma: float = 0.05, stated: float = 0.05, slope: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """X and Q: the scene in another unit, tilted, with errors by cells of 8 px."""
    rng = np.random.default_rng(seed)
    cells = rng.normal(size=(-(-CAMERA.height // 8), -(-CAMERA.width // 8)))
    error = np.kron(cells, np.ones((8, 8)))[: CAMERA.height, : CAMERA.width]
    across = np.linspace(-1.0, 1.0, CAMERA.width)
    z = unit * TRUTH * np.exp(sigma * error + slope * across)
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    X = (rays * z[..., None]).astype(np.float32)
    return X, np.full(z.shape, 1.0 / stated**2, np.float32)


def affine_network(
    scale: float = 3.0, shift: float = 0.3, sigma: float = 0.05, stated: float = 0.05, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """X and Q of a network whose inverse depths are ``scale`` (true + ``shift``)."""
    X, Q = network(1.0, sigma, stated, seed=seed)
    z = 1.0 / (scale * (1.0 / X[..., 2].astype(np.float64) + shift))
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    return (rays * z[..., None]).astype(np.float32), Q
