"""A smooth displacement of the whole picture from single matches, for dense flow to start from."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from aquaflow.prior.contract import Float, Mask
from aquaflow.prior.fields import pixel_grid, sample
from aquaflow.prior.homography import MIN_INLIERS, RANSAC_PX, flow_of_homography

CELL_PX = 8
"""Of the grid that matches are spread on: dense flow corrects what is finer."""
SMOOTH_CELLS = 1.5
"""Sigma of the spreading, as in prior.coarse."""
MOTION_WEIGHT = 0.02
"""Of the homography, in matches per cell: it decides where there is no match, as in prior.coarse.
"""
NEIGHBOURS = 6
"""Nearest matches that judge one; wrong matches seldom have wrong ones alike next to them."""
AGREEMENT = 0.03
"""Of the picture's width: largest difference from the median of the neighbours' residuals."""


def flow_from_matches(
    pixels_a: Float,  # [M, 2] px
    pixels_b: Float,  # [M, 2] px
    height: int,
    width: int,
) -> Float | None:
    """[height, width, 2] px from a to b: the homography of most matches, and around each match
    what it differs from that; None where too few agree."""
    if len(pixels_a) < MIN_INLIERS:
        return None
    H, inliers = cv2.findHomography(pixels_a, pixels_b, cv2.USAC_MAGSAC, RANSAC_PX)
    if H is None or inliers is None or int(inliers.sum()) < MIN_INLIERS:
        return None
    motion = flow_of_homography(np.asarray(H, np.float64), height, width)
    residuals = pixels_b - pixels_a - sample(motion, pixels_a[None])[0]
    good = _agree_with_neighbours(pixels_a, residuals, AGREEMENT * width)
    return motion + _spread(pixels_a[good], residuals[good], height, width)


def _agree_with_neighbours(
    pixels: Float,  # [M, 2] px
    residuals: Float,  # [M, 2] px
    within: float,
) -> Mask:
    """[M]"""
    _, around = cKDTree(pixels).query(pixels, min(NEIGHBOURS + 1, len(pixels)))
    usual = np.median(residuals[around], axis=1)
    return np.asarray(np.linalg.norm(residuals - usual, axis=1) < within)


def _spread(
    pixels: Float,  # [M, 2] px
    residuals: Float,  # [M, 2] px
    height: int,
    width: int,
) -> Float:
    """[height, width, 2] px, smooth; zero far from every match."""
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    cells = np.clip((pixels / CELL_PX).astype(int), 0, (columns - 1, rows - 1))
    total = np.zeros((rows, columns), np.float32)
    summed = np.zeros((rows, columns, 2), np.float32)
    np.add.at(total, (cells[:, 1], cells[:, 0]), 1.0)
    np.add.at(summed, (cells[:, 1], cells[:, 0]), residuals)
    total = np.asarray(cv2.GaussianBlur(total, (0, 0), SMOOTH_CELLS))
    summed = np.asarray(cv2.GaussianBlur(summed, (0, 0), SMOOTH_CELLS))
    grid = pixel_grid(height, width) / np.float32(CELL_PX)
    return sample(summed / (total + np.float32(MOTION_WEIGHT))[..., None], grid)
