"""Surface points as several pictures show them: what the water is estimated from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.water.grouping import mean_by
from aquaflow.mapping.water.regions import regions_of

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


FEWEST_AROUND = 4
"""Points of one region in one view whose mean stands for a point's surroundings."""
LEAST_COLOUR = 0.02
"""Guards the division by a black point's colour."""


@dataclass(frozen=True)
class Observations:
    """Surface points in several pictures; one row per observation."""

    point: Index
    """[M] number of the point, 0 to P - 1."""
    view: Index
    """[M] number of the view, 0 to V - 1."""
    colour: Array
    """[M, 3] as the camera saw it, at one and the same footprint per point."""
    z: Array
    """[M] range, map units."""
    xy: Array
    """[M, 2] where in the picture, each axis from -1 to 1."""
    blend: Array
    """[M, 3] how much brighter than the point its footprint is, neighbours included, as it would
    look at the point's mean range."""
    positions: Array
    """[P, 3] world, map units."""

    @cached_property
    def region(self) -> Index:
        """[P] number of the region of the scene that each point lies in."""
        return regions_of(self.positions)

    @cached_property
    def around(self) -> Array:
        """[M, 3] mean colour of each observation's region in the same view; where there are too few
        points, the observation's own."""
        cell = self.region[self.point] * (int(self.view.max()) + 1) + self.view
        enough = np.bincount(cell)[cell] >= FEWEST_AROUND
        return np.where(enough[:, None], mean_by(cell, self.colour)[cell], self.colour)

    @property
    def points(self) -> int:
        """Number P of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0


def variance_over_range(
    observations: Observations,
    colours: Array,  # [M, 3] of the same observations
) -> float:
    """Relative variance of the points' colours that follows from the range they are seen at.

    Of all points together, so that noise, which is worse from afar, has no part in it: 0 if points
    look on the mean the same from near and far.
    """
    seen = observations
    mean = np.maximum(mean_by(seen.point, colours), LEAST_COLOUR)[seen.point]
    log_z = np.log(seen.z)
    nearness = log_z - mean_by(seen.point, log_z[:, None])[seen.point, 0]
    spread = float((nearness**2).mean())
    slopes = (nearness[:, None] * (colours / mean - 1.0)).mean(axis=0) / max(spread, 1e-12)
    return float((slopes**2).mean() * spread)
