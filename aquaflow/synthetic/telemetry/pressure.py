"""The depth cell."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.synthetic.motion import BodyMotion
from aquaflow.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["depth"]

Array: TypeAlias = npt.NDArray[np.float64]


def depth(
    t: Array,  # [N] s
    motion: BodyMotion,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 1] m below the surface."""
    white = noise.depth_sigma_m * rng.standard_normal((len(t), 1))
    return np.asarray(motion.origin_w(t)[:, 2:] + white)
