"""A picture that networks are tried on: always the same, and with structure of all sizes."""

from __future__ import annotations

import cv2
import numpy as np

from aquaflow.prior.network import Picture

OCTAVES = (4, 8, 16, 32, 64)
"""Patches along the picture's shorter side, each half as strong as the one before."""
CONTRAST = 60.0
"""Grey values of the coarsest; the brightest and darkest of 255 are not reached by most pixels."""


def example_picture(height: int, width: int, seed: int = 0) -> Picture:
    """[height, width, 3]"""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for number, patches in enumerate(OCTAVES):
        side = max(min(height, width) // patches, 1)
        shape = (-(-height // side) + 1, -(-width // side) + 1, 3)
        lattice = rng.normal(size=shape).astype(np.float32)
        octave = cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
        total += np.asarray(octave, dtype=np.float32) / np.float32(2.0**number)
    return np.asarray(np.clip(127.0 + CONTRAST * total, 0.0, 255.0), dtype=np.uint8)
