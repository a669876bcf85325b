"""Textured pictures for the prior's tests: a texture that can be looked up anywhere, smoothly."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.flow import Float, Grey

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

WIDTH, HEIGHT = 240, 180
CAMERA = CameraModel(WIDTH, HEIGHT, 200.0, 200.0, 120.0, 90.0)
FAR = (0.4 * WIDTH, -20.0)
"""px: a shift that flow does not find from nothing."""
MARGIN = 240
"""Pixels of texture around the picture, so that moved pictures stay inside it."""


def texture(seed: int, width: int = WIDTH + 2 * MARGIN, height: int = HEIGHT + 2 * MARGIN) -> Array:
    """[height, width] grey values 0 to 255 with detail at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for sigma in (1.2, 3.0, 8.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma)
        total += layer / layer.std()
    return np.asarray(np.clip(127.0 + 32.0 * total, 0, 255))


def rgb(grey: Array) -> Picture:
    return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def pixel_centres() -> Array:
    """[HEIGHT, WIDTH, 2]"""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([u, v], -1)


def mapped(H: Array, pixels: Array) -> Array:
    """[..., 2] pixels sent through the homography."""
    m = pixels @ H[:, :2].T + H[:, 2]
    return np.asarray(m[..., :2] / m[..., 2:])


def lookup(field: Array, where: Array) -> Array:
    """Values [H, W] of a texture at picture pixels ``where`` [H, W, 2], cubic."""
    xy = (where + MARGIN - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(field, xy[..., 0], xy[..., 1], cv2.INTER_CUBIC))


def moved_pair(H: Array, seed: int = 0) -> tuple[Picture, Picture]:
    """Pictures (a, b) such that pixel p of a is seen at H p in b."""
    field = texture(seed)
    grid = pixel_centres()
    return rgb(lookup(field, grid)), rgb(lookup(field, mapped(np.linalg.inv(H), grid)))


def grey_pair(H: Array) -> tuple[Grey, Grey]:
    """[H, W] the pair of :func:`moved_pair` without colour."""
    a, b = moved_pair(H)
    return a[..., 0].copy(), b[..., 0].copy()


def true_flow(H: Array) -> Float:
    """[H, W, 2] px, of that pair."""
    grid = pixel_centres()
    return np.asarray(mapped(H, grid) - grid, dtype=np.float32)


def shift(dx: float, dy: float) -> Array:
    return np.array([[1.0, 0.0, dx], [0.0, 1.0, dy], [0.0, 0.0, 1.0]])


def inside(pixels: Array, margin: float) -> npt.NDArray[np.bool_]:
    """[...] True where a pixel lies ``margin`` or more inside the picture."""
    size = np.array([WIDTH, HEIGHT])
    return np.asarray(((pixels > margin) & (pixels < size - margin)).all(-1))
