"""Where a picture went, coarsely: a homography from SIFT matches, to start dense flow from."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.prior.contract import Keypoints, Mask
from aquaflow.prior.flow import Float, Grey, pixel_grid

Index = npt.NDArray[np.int64]

SIFT_FEATURES = 2000
"""Strongest keypoints of a picture that are kept."""
SIFT_CONTRAST = 0.015
"""Below OpenCV's 0.04: water lowers contrast (notes/2026-11-tracking.md#initialisation)."""
LOWE_RATIO = 0.8
"""Best over second-best distance of a match that is accepted (D. Lowe, IJCV 2004: 0.8)."""
RANSAC_PX = 4.0
"""Loose on purpose: relief does not follow a homography, the flow takes care of the rest."""
MIN_INLIERS = 12
"""Three times the minimal sample of four."""
MIN_DENOMINATOR = 1e-6
"""On the plane's horizon the denominator is zero."""


def detect(
    grey: Grey,  # [H, W]
    mask: Mask | None = None,  # [H, W] True where the scene is seen
    most: int = SIFT_FEATURES,
) -> Keypoints:
    """The ``most`` SIFT keypoints that are strongest; empty where the picture shows nothing."""
    sift = cv2.SIFT.create(most, contrastThreshold=SIFT_CONTRAST)
    points, descriptors = sift.detectAndCompute(
        grey, None if mask is None else mask.astype(np.uint8)
    )
    if descriptors is None:
        return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    pixels = np.array([point.pt for point in points], dtype=np.float32) + 0.5
    return Keypoints(pixels, np.asarray(descriptors, dtype=np.float32))


def clear_matches(a: Keypoints, b: Keypoints) -> tuple[Index, Index]:
    """Indices [M] into a and into b, which has two at least: the nearest descriptor of b to each of
    a, where it is clearly nearer than the second."""
    # |x - y|^2 = |x|^2 - 2 x . y + |y|^2, of SIFT in whole numbers that float32 holds exactly. One
    # product of matrices takes a third of the time of OpenCV's matcher.
    product = a.descriptors @ b.descriptors.T
    product *= -2.0
    product += (b.descriptors**2).sum(1)
    rows, nearest = np.arange(len(product)), product.argmin(1)
    own = (a.descriptors**2).sum(1)
    best = np.maximum(own + product[rows, nearest], 0.0)
    product[rows, nearest] = np.inf
    second = np.maximum(own + product.min(1), 0.0)
    clear = np.flatnonzero(best < LOWE_RATIO**2 * second)
    return clear, nearest[clear]


def homography(a: Keypoints, b: Keypoints) -> npt.NDArray[np.float64] | None:
    """[3, 3] map from pixels of a to pixels of b, or None where the pictures do not match."""
    if len(a.pixels) < MIN_INLIERS or len(b.pixels) < MIN_INLIERS:
        return None
    mine, theirs = clear_matches(a, b)
    if len(mine) < MIN_INLIERS:
        return None
    H, inliers = cv2.findHomography(a.pixels[mine], b.pixels[theirs], cv2.USAC_MAGSAC, RANSAC_PX)
    if H is None or inliers is None or int(inliers.sum()) < MIN_INLIERS:
        return None
    return np.asarray(H, dtype=np.float64)


def flow_of_homography(
    H: npt.NDArray[np.float64],  # [3, 3]
    height: int,
    width: int,
) -> Float:
    """[H, W, 2] displacement in pixels that ``H`` gives every pixel."""
    grid = pixel_grid(height, width).astype(np.float64)
    mapped = grid @ H[:, :2].T + H[:, 2]
    # The denominator changes sign behind the plane's horizon: such pixels keep a finite nonsense
    # flow, which the forward-backward check throws away.
    w = mapped[..., 2:]
    w = np.where(np.abs(w) < MIN_DENOMINATOR, MIN_DENOMINATOR, w)
    limit = 2.0 * (height + width)
    return np.clip(mapped[..., :2] / w - grid, -limit, limit).astype(np.float32)
