"""Robust statistics: what a spread is, and how far off a value may be that still counts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAD_TO_SIGMA = 1.4826
"""Standard deviation over the median absolute deviation, of a normal distribution."""
TUKEY = 4.685
"""Standard deviations beyond which Tukey's biweight counts nothing: 95 % efficiency under Gaussian
noise."""


def biweight(
    residual: Array,  # [M]
    sigma: Array | float,  # [M] or one for all
) -> Array:
    """[M] weights in [0, 1]: 0 for what is off by TUKEY sigmas or more."""
    return np.asarray(np.clip(1.0 - (residual / (TUKEY * sigma)) ** 2, 0.0, None) ** 2)
