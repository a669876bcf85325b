"""Marine snow: opaque bright flakes that drift through the picture on their own ways."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.stress.swim import Picture

RADIUS_WIDTHS = (0.01, 0.035)
"""Smallest and largest flake: some millimetres, a hand's breadth from the lens."""
DRIFT_WIDTHS = 0.015
"""Of all flakes together, per frame: 0.15 widths/s at 10 frames/s."""
OWN_WIDTHS = 0.008
"""Standard deviation, per frame, of each flake's own way."""
BRIGHTNESS = (190, 255)
"""Grey levels: flakes near the lens are close to overexposed."""
SUBPIXEL_BITS = 4
"""Fractional bits of OpenCV's coordinates: flakes move by a sixteenth of a pixel."""
EDGE_PX = 1.1
"""OpenCV draws a disc so much wider than its radius."""


def marine_snow(
    camera: CameraModel, cover: float, seed: int, first: int = 0
) -> Callable[[Picture, int], Picture]:
    """Puts flakes over the share ``cover`` of the picture with a given index.

    They move steadily from frame ``first`` on; one that leaves comes in on the other side.
    """
    rng = np.random.default_rng([seed, 40])
    size = np.array([camera.width, camera.height])
    margin = RADIUS_WIDTHS[1] * camera.width
    span = size + 2.0 * margin
    # A drawn disc reaches most of a pixel further than its radius.
    reach = np.linspace(*RADIUS_WIDTHS, 100) * camera.width + EDGE_PX
    mean_area = np.pi * float(np.mean(reach**2))
    # Flakes overlap: of n at random places, exp(-n area / span) of the picture stays free.
    count = round(-np.log(1.0 - cover) * float(span.prod()) / mean_area)
    radius = rng.uniform(*RADIUS_WIDTHS, count) * camera.width
    start = rng.uniform(0.0, 1.0, (count, 2)) * span
    angle = rng.uniform(0.0, 2.0 * np.pi)
    drift = DRIFT_WIDTHS * np.array([np.cos(angle), np.sin(angle)])
    velocity = (drift + OWN_WIDTHS * rng.standard_normal((count, 2))) * camera.width
    grey = rng.integers(*BRIGHTNESS, count)

    def snow(picture: Picture, index: int) -> Picture:
        covered = picture.copy()
        centres = (start + velocity * (index - first)) % span - margin
        unit = 1 << SUBPIXEL_BITS
        for (x, y), r, level in zip(centres * unit, radius * unit, grey, strict=True):
            colour = (int(level),) * 3
            centre = (round(x), round(y))
            cv2.circle(covered, centre, round(r), colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)
        return covered

    return snow
