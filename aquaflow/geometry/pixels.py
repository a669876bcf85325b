"""Values of a field at pixel positions (docs/conventions.md: a pixel's centre is at + 0.5)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Scalar = TypeVar("Scalar", bound=np.generic)


def at_pixels(
    field: npt.NDArray[Scalar],  # [H, W]
    pixels: npt.NDArray[np.float64] | npt.NDArray[np.float32],  # [M, 2] px
) -> npt.NDArray[Scalar]:
    """[M] values of the pixels' own cells."""
    height, width = field.shape
    column = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, height - 1)
    return field[row, column]
