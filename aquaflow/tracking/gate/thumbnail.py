"""Measures of a small grey thumbnail: texture above the noise, sharpness, motion.

Measured in tiles, so that one fish or one lamp does not decide for the whole picture, and at one
size, so that it costs the same at every resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

THUMBNAIL_WIDTH = 160
"""px; keeps the texture that tracking uses, removes most of the sensor's noise."""
TILES = (12, 9)
"""Columns and rows of tiles."""
COARSE_CELLS = 20
"""Width of the picture in which blur over 5 % of the width leaves the gradients alone."""
SATURATED = 250.0
"""Grey level from which a pixel counts as saturated."""
LEVEL_NOISE = 12.0**-0.5
"""Standard deviation of rounding to whole grey levels: the least noise of an 8-bit picture."""
NOISE_TAPS = np.array([1, -2, 1], np.float32)
"""Second difference, taken both ways: blind to planes and straight edges (Immerkaer 1996); its
response to white noise of sigma 1 has the standard deviation 6 and the mean size
6 sqrt(2 / pi)."""
NOISE_QUANTILE = 0.1
"""The calmest tiles show the noise, the others texture too."""
MOTION_SNR = 3.0
"""Signal to noise of a tile whose motion is measured: below, noise in the gradients shrinks it."""
SMOOTHING_PX = 1.0
"""Of the thumbnail: central differences see the steepest detail too flat, its motion too large."""
EXPOSURE_CHANGE = 2.0
"""Largest gain between two pictures of one view; unbounded it makes any two textures alike."""
LINEAR_PX = 0.5
"""Difference over gradient, in thumbnail pixels, up to which their quotient is a motion."""


@dataclass(frozen=True)
class Thumbnail:
    """A small grey version of one picture and the measures taken on it."""

    grey: Float
    """[h, w] grey levels, smoothed for motion."""
    seen: Float
    """[h, w] 1 where the scene is seen: not masked, not saturated."""
    snr: Float
    """[tiles] gradient over what the noise alone would give; 0 where little is seen."""
    usable: float
    """Share of the unmasked tiles that show texture above the noise."""
    level: float
    """Mean grey level."""
    sharpness: Float
    """[4] fine gradient energy in four directions over coarse energy: blur takes it, contrast does
    not change it."""


def measure_thumbnail(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
    mask: Mask | None,  # [H, W]
    min_snr: float,
) -> Thumbnail:
    """Measure everything but motion; a tile with at least ``min_snr`` has texture."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    height, width = grey.shape
    small_width = min(THUMBNAIL_WIDTH, width)
    size = (small_width, max(round(height * small_width / width), TILES[1]))
    thumbnail = _shrunk(grey.astype(np.float32), size)
    scene = np.ones_like(thumbnail)
    if mask is not None:
        # Half-masked pixels would show the mask's edge, not the scene's.
        scene = (_shrunk(mask.astype(np.float32), size) > 0.99).astype(np.float32)
    seen = scene * (thumbnail < SATURATED)
    response = np.abs(np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, NOISE_TAPS, NOISE_TAPS)))
    sigma = float(np.quantile(_tile_means(response), NOISE_QUANTILE)) * np.sqrt(np.pi / 2) / 6
    # Area averaging divides white noise by the shrinking factor.
    noise = max(sigma, LEVEL_NOISE) * small_width / width

    gx, gy = _gradients(thumbnail)
    weight, energy, of_scene = _tile_means(np.stack([seen, (gx * gx + gy * gy) * seen, scene]))
    energy = energy / np.maximum(weight, 1e-6)
    snr = np.where(weight > 0.5, np.sqrt(energy) / noise, 0.0).astype(np.float32)
    unmasked = of_scene > 0.5
    usable = float((snr > min_snr)[unmasked].mean()) if unmasked.any() else 0.0
    level = float(thumbnail[scene > 0].mean()) if scene.any() else 0.0
    coarse = (COARSE_CELLS, max(round(size[1] * COARSE_CELLS / size[0]), 2))
    # The masked part of a picture does not change, so it changes no ratio to the running level.
    relief = float(_step_energies(_shrunk(thumbnail, coarse)).mean())
    sharpness = _step_energies(thumbnail) / max(relief, 1e-6)
    smooth = np.asarray(cv2.GaussianBlur(thumbnail, (0, 0), SMOOTHING_PX), dtype=np.float32)
    return Thumbnail(smooth, seen, snr, usable, level, sharpness)


def motion_widths(reference: Thumbnail, thumbnail: Thumbnail, share: float) -> float:
    """Displacement, in picture widths, that ``share`` of the textured tiles stay below.

    One Lucas-Kanade step for each tile. Infinite where the difference is no small motion, or where
    no tile has enough texture.
    """
    seen = reference.seen * thumbnail.seen
    old, new = _same_exposure(reference.grey, thumbnail.grey, seen)
    gx, gy = _gradients(0.5 * (old + new))
    d = (new - old) * seen
    gx, gy = gx * seen, gy * seen
    products = np.stack([gx * gx, gx * gy, gy * gy, gx * d, gy * d, d * d])
    xx, xy, yy, xd, yd, dd = _tile_means(products)
    textured = (np.minimum(reference.snr, thumbnail.snr) > MOTION_SNR) & (xx + yy > 0)
    if not textured.any():
        return float("inf")
    trace = (xx + yy)[textured]
    difference = np.sqrt(dd[textured] / trace)
    if float(np.quantile(difference, share)) > LINEAR_PX:
        return float("inf")
    # Along an edge nothing is measured: a small ridge leaves that component at zero.
    ridge = 1e-2 * trace
    xx, xy, yy = xx[textured] + ridge, xy[textured], yy[textured] + ridge
    xd, yd = xd[textured], yd[textured]
    size = np.hypot(yy * xd - xy * yd, xx * yd - xy * xd) / (xx * yy - xy * xy)
    width = int(thumbnail.grey.shape[1])
    return float(np.quantile(size, share)) / width


def _same_exposure(
    old: Float,  # [h, w]
    new: Float,  # [h, w]
    seen: Float,  # [h, w]
) -> tuple[Float, Float]:
    """``old`` with gain and offset of ``new``, by least squares, and ``new``."""
    count = max(float(seen.sum()), 1.0)
    mean_old, mean_new = float((old * seen).sum()) / count, float((new * seen).sum()) / count
    centred = (old - mean_old) * seen
    variance = float((centred * centred).sum())
    gain = float((centred * (new - mean_new)).sum()) / max(variance, 1e-6)
    gain = float(np.clip(gain, 1.0 / EXPOSURE_CHANGE, EXPOSURE_CHANGE))
    return (gain * (old - mean_old) + mean_new).astype(np.float32), new


def _shrunk(
    picture: Float,  # [H, W]
    size: tuple[int, int],  # width, height
) -> Float:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _tile_means(
    pictures: Float,  # [..., H, W]
) -> Float:
    """[..., rows, columns] mean over each tile; several times as fast as ``_shrunk``, which has no
    vectors for sides that are no whole numbers of pixels."""
    columns, rows = TILES
    down, across = (
        _area_weights(pictures.shape[-2], rows),
        _area_weights(pictures.shape[-1], columns),
    )
    return np.asarray(down @ pictures @ across.T, dtype=np.float32)


@lru_cache(maxsize=8)
def _area_weights(length: int, parts: int) -> Float:
    """[parts, length] share of each pixel in the mean of each of ``parts`` equal parts."""
    edges = np.linspace(0.0, length, parts + 1)[:, None]
    pixels = np.arange(length)
    overlap = np.minimum(edges[1:], pixels + 1) - np.maximum(edges[:-1], pixels)
    weights = np.asarray(np.maximum(overlap, 0.0) * (parts / length), dtype=np.float32)
    weights.setflags(write=False)
    return weights


def _gradients(
    picture: Float,  # [h, w]
) -> tuple[Float, Float]:
    """Central differences along x and y; their noise has the picture's own sigma, over sqrt 2."""
    step = np.array([[-0.5, 0.0, 0.5]], np.float32)
    gx = cv2.filter2D(picture, cv2.CV_32F, step)
    gy = cv2.filter2D(picture, cv2.CV_32F, np.ascontiguousarray(step.T))
    return np.asarray(gx), np.asarray(gy)


def _step_energies(
    picture: Float,  # [h, w]
) -> Float:
    """[4] mean squared difference of neighbours: along x, along y and along both diagonals.

    Four, because motion blur takes the detail along the motion and leaves the rest.
    """
    steps = (
        picture[:, 1:] - picture[:, :-1],
        picture[1:] - picture[:-1],
        picture[1:, 1:] - picture[:-1, :-1],
        picture[1:, :-1] - picture[:-1, 1:],
    )
    return np.array([np.mean(step * step) for step in steps], np.float32)
