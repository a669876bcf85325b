"""What moves by itself: fish, a diver, the vehicle's own arm (paper, Sec. 3.2: C and Q).

A match on something that moves is triangulated like any other, and gets a depth that its motion
made up. The network looks at shape and not at motion: where the two differ by more than both their
errors over a whole region, neither is to be trusted with a place in the map.
"""

from __future__ import annotations

import cv2
import numpy as np

from aquaflow.keyframes import UNKNOWN_VARIANCE, Pointmap
from aquaflow.prior.contract import Mask
from aquaflow.tracking.learned.scaling import LearnedDepth

DIFFERS_SIGMAS = 4.0
"""Difference of the logarithms of both depths beyond which they are of different things. Of clips
and dives without anything that moves, 0 to 0.2 % of the pixels are taken for it
(docs/prior.md#moving)."""
LEAST_WIDTHS = 0.05
"""Side of the smallest region, over the picture's width: one and a half cells of a network, whose
error is that of a whole cell."""


def moving(pointmap: Pointmap, depth: LearnedDepth) -> Mask:
    """[H, W] pixels whose triangulated depth the learned one contradicts, in regions."""
    rho, variance = pointmap.rho, pointmap.variance
    both = depth.known & (rho > 1e-6) & (variance < UNKNOWN_VARIANCE)
    ratio = np.log(np.where(both, rho, 1.0) / np.where(both, depth.rho, 1.0))
    own = np.where(both, variance, 0.0) / np.where(both, rho, 1.0) ** 2
    allowed = DIFFERS_SIGMAS * np.sqrt(np.where(both, depth.variance, 1.0) + own)
    differs = (both & (np.abs(ratio) > allowed)).astype(np.uint8)
    side = max(3, round(LEAST_WIDTHS * rho.shape[1]) | 1)
    kernel = np.ones((side, side), np.uint8)
    return np.asarray(cv2.dilate(cv2.morphologyEx(differs, cv2.MORPH_OPEN, kernel), kernel) > 0)
