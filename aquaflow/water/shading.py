"""How the camera darkens its own picture: lamp and lens fall-off, fixed to the camera.

A smooth gain g(x, y) = exp(q(x, y)) multiplies the whole picture, water included; q is a quadratic
without a constant, so g = 1 in the middle. The paper has none; without it a lamp's fall-off is
taken for water.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TERMS = 5
"""x, y, x^2, x y and y^2: vignetting and a lamp at the side; a constant would be exposure."""
MAX_LOG_GAIN = 2.0
"""Guards the exponential: a picture seven times darker at its edge shows nothing there anyway."""


def shading_basis(
    xy: Array,  # [..., 2] picture position, each axis from -1 to 1
) -> Array:
    """[..., 5]: x, y, x^2, x y, y^2."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def gain_map(
    coefficients: Array,  # [5]
    height: int,
    width: int,
) -> npt.NDArray[np.float32]:
    """g [H, W] at the pixel centres."""
    x = (np.arange(width) + 0.5) / (0.5 * width) - 1.0
    y = (np.arange(height) + 0.5) / (0.5 * height) - 1.0
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    log_gain = np.clip(shading_basis(xy) @ coefficients, -MAX_LOG_GAIN, MAX_LOG_GAIN)
    return np.exp(log_gain).astype(np.float32)
