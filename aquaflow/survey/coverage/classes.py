"""How well each cell was seen: its class, from the counts and from how far the water lets see."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import CoverageConfig
from aquaflow.survey.coverage.raster import RANGE_BINS, Counts, GridFrame, Sides

Classes = npt.NDArray[np.uint8]


class CoverageClass(IntEnum):
    """Classes in the order of how much is known."""

    NOT = 0
    TOO_FAR = 1
    """Only from beyond the range that the water allows."""
    SPARSE = 2
    """From near enough, but by too few views or from one side only."""
    WELL = 3


COLOURS = {
    CoverageClass.TOO_FAR: (191, 75, 52),
    CoverageClass.SPARSE: (233, 189, 62),
    CoverageClass.WELL: (22, 148, 125),
}
"""RGB of each class that is drawn; brick, yellow and teal differ for the colour-blind, too."""
WORDS = {
    CoverageClass.NOT: "not seen",
    CoverageClass.TOO_FAR: "too far for this water",
    CoverageClass.SPARSE: "seen sparsely",
    CoverageClass.WELL: "seen well",
}
"""As legends say it."""


def near_bins(frame: GridFrame, limit: float | None) -> int:
    """How many bins of ranges are within ``limit``, map units; all where nothing limits.

    A bin counts as within if most of it is: by its geometric middle.
    """
    if limit is None:
        return RANGE_BINS
    middles = frame.bin_ends()[:-1] / (2.0**0.125)
    return int(np.searchsorted(middles, limit, side="right"))


def classify(
    by_range: Counts,  # [..., 12] as in a tile
    by_direction: Sides,  # [..., 17] likewise
    near: int,
    config: CoverageConfig,
) -> Classes:
    """[...] a :class:`CoverageClass` for each cell; ``near`` as from :func:`near_bins`."""
    views = by_range[..., :near].sum(axis=-1, dtype=np.int64)
    sides = (by_direction > 0).sum(axis=-1)
    well = (views >= config.least_views) & (sides >= config.least_directions)
    found = np.full(views.shape, int(CoverageClass.NOT), np.uint8)
    found[by_range.any(axis=-1)] = CoverageClass.TOO_FAR
    found[views > 0] = CoverageClass.SPARSE
    found[well] = CoverageClass.WELL
    return found
