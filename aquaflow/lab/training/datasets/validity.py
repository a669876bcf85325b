"""Which pixels teach: not the moving, the mirroring, the veiled, or those of unknown depth.

Paper, Sec. 3.1: "joint geometric and semantic masking to remove dynamic objects, invalid depth
regions, specular highlights, and scattering artifacts". What moved is found from geometry here: a
point of one view in front of what the other view sees there was not there any more.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.lab.training.correspondences import nearest_pixels, project
from aquaflow.lab.training.datasets.posed import Posed
from aquaflow.lab.training.pairs import ViewBatch, seen_from

Mask = npt.NDArray[np.bool_]

NEAR_M, FAR_M = 0.1, 80.0
"""Depths beyond are the simulator's sky, and no camera in water sees there."""
HIGHLIGHT = 250
"""Grey level that all three channels reach in a mirrored lamp or sun."""
HIGHLIGHT_BORDER_PX = 2
"""Around a highlight, its glare."""
CONTRAST_WINDOW_PX = 15
"""Edge of the window that the contrast is measured in."""
VEILED = 0.7
"""Grey levels of contrast: rounding alone makes 0.3, and where no more is left only the veil is
seen."""
THROUGH = 0.1
"""Share of its depth by which a point lies in front of what the other view sees in its place."""


def valid_pixels(posed: Posed) -> Mask:
    """[H, W] of one picture alone: depth is known, no highlight, not lost in the veil."""
    known = np.isfinite(posed.depth) & (posed.depth > NEAR_M) & (posed.depth < FAR_M)
    return known & ~_highlights(posed.image) & ~_veiled(posed.image)


def moved(a: ViewBatch, b: ViewBatch) -> Tensor:
    """[B, H, W] bool: a's point would hide what b sees there, so it was elsewhere by then."""
    points = seen_from(b.T_wc, a.points(), a.T_wc)
    pixels, inside = project(points, b)
    rows, columns = nearest_pixels(pixels, b)
    batch = torch.arange(len(rows), device=rows.device)[:, None, None]
    seen = b.depth[batch, rows, columns]
    known = inside & a.valid & b.valid[batch, rows, columns]
    return known & (seen > (1.0 + THROUGH) * points[..., 2])


def _highlights(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
) -> Mask:
    bright = (image.min(axis=2) >= HIGHLIGHT).astype(np.uint8)
    side = 2 * HIGHLIGHT_BORDER_PX + 1
    return np.asarray(cv2.dilate(bright, np.ones((side, side), np.uint8)) > 0)


def _veiled(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
) -> Mask:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    size = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
    mean = cv2.blur(grey, size)
    variance = np.maximum(cv2.blur(grey * grey, size) - mean * mean, 0.0)
    return np.asarray(np.sqrt(variance) < VEILED)
