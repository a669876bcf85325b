"""Weak priors on the colours of surface points without water."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.config import WaterPriorsConfig

Array = npt.NDArray[np.float64]

DARK_SHARE, DARK_LEVEL, DARK_SIGMA = 0.02, 0.02, 0.2
"""The darkest 2 % of the points are shadows, nearly black (dark channel, He et al. 2011). Weak, as
sand has none: beta_a of six known waters is 9 % wrong with a sigma of 0.1, 7 % with 0.2 and 0.5."""
BRIGHT_SHARE, BRIGHT_LEVEL, BRIGHT_SIGMA = 0.02, 1.0, 0.2
"""Only the brightest 2 % of the points may be brighter than the camera's white (saturation)."""


@dataclass(frozen=True)
class Belief:
    """How far the points' colours are from what is usual, whitened."""

    residual: float
    by_J: dict[int, Array] = field(default_factory=dict)
    """Derivative [P] by the points' J, of the channels that it depends on."""


def beliefs(
    J: Array,  # [3, P]
    config: WaterPriorsConfig,
) -> list[Belief]:
    """All that are switched on."""
    found: list[Belief] = []
    for c in range(3):
        if config.dark_channel:
            found.append(_rank(J, c, DARK_SHARE, DARK_LEVEL, DARK_SIGMA))
        if config.saturation:
            bright = _rank(J, c, 1.0 - BRIGHT_SHARE, BRIGHT_LEVEL, BRIGHT_SIGMA)
            found += [bright] if bright.residual > 0.0 else []
    return found


def _rank(
    J: Array,  # [3, P]
    c: int,
    share: float,
    level: float,
    sigma: float,
) -> Belief:
    """The point with ``share`` of the others below it, against the level that it should have."""
    rank = int(share * (J.shape[1] - 1))
    point = int(np.argpartition(J[c], rank)[rank])
    by_J = np.zeros(J.shape[1])
    by_J[point] = 1.0 / sigma
    return Belief(float((J[c, point] - level) / sigma), {c: by_J})
