"""How wide and how long the strip is that a picture shows, across and along the path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.survey.coverage.plan import Sight

Array = npt.NDArray[np.float64]

MOST_SIGHTS = 15
"""Keyframes that the median is of."""
DEPTHS = (0.5, 2.0)
"""Times the median depth within which a block counts: one wrong match must not make the strip
wider."""


def extent(
    sights: Sequence[Sight],
    direction: Array,  # [3] unit vector in the sub-map's world
) -> float:
    """Median length along ``direction`` of what pictures show, map units; 0 without pictures."""
    chosen = np.linspace(0, len(sights) - 1, min(len(sights), MOST_SIGHTS)).round().astype(int)
    lengths = [length for i in chosen if (length := _extent(sights[i], direction)) > 0.0]
    return float(np.median(lengths)) if lengths else 0.0


def _extent(
    sight: Sight,
    direction: Array,  # [3] unit
) -> float:
    footprint, T_mc = sight
    corners, depths = footprint.patches()
    if len(corners) == 0:
        return 0.0
    low, high = np.array(DEPTHS) * footprint.depth
    near = corners[(depths >= low) & (depths <= high)]
    along = T_mc.apply(near.reshape(-1, 3)) @ direction
    return float(np.ptp(along)) if len(along) else 0.0
