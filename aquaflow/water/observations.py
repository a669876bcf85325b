"""Patches of the scene's surface in several pictures: what the water is estimated from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.water.grouping import mean_by
from aquaflow.water.regions import regions_of

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

OPEN_WATER_ERROR = 2.0
"""Standard deviation of open water's errors over that of a patch: what looks open may be ground
that is dim and far. Taken at its word, beta_a of murky rendered dives was 5 to 10 % too small."""
LEAST_COLOUR = 0.02
"""Guards the division by a black patch's colour."""


@dataclass(frozen=True)
class Observations:
    """Patches of the surface ("points") in several pictures; one row per observation, those of a
    point one after another, at most one in each view. Open water comes last, each row a point of
    its own (open_sightings.py)."""

    point: Index
    """[M] number of the point, 0 to P - 1, rising."""
    view: Index
    """[M] number of the view, 0 to V - 1."""
    colour: Array
    """[M, 3] as the camera saw it, mean over the same piece of surface in all views."""
    z: Array
    """[M] range, map units."""
    xy: Array
    """[M, 2] where in the picture, each axis from -1 to 1."""
    positions: Array
    """[S, 3] world, map units; points from S on are open water."""

    @cached_property
    def region(self) -> Index:
        """[S] number of the region of the scene that each point lies in."""
        return regions_of(self.positions)

    @cached_property
    def errors_shared(self) -> Index:
        """[M] number of what observations share their errors with: all of a region, or of one
        view's open water."""
        on_surface = self.point < self.surface
        region = self.region[np.where(on_surface, self.point, 0)]
        return np.where(on_surface, region, int(self.region.max(initial=-1)) + 1 + self.view)

    @cached_property
    def error_scale(self) -> Array:
        """[M] standard deviation of the error over that of a patch of surface."""
        return np.where(self.point < self.surface, 1.0, OPEN_WATER_ERROR)

    @cached_property
    def median_range(self) -> float:
        """Of the surface, map units."""
        return float(np.median(self.z[self.point < self.surface]))

    @property
    def surface(self) -> int:
        """Number S of points on the surface."""
        return len(self.positions)

    @cached_property
    def starts(self) -> Index:
        """[P] row of each point's first observation."""
        return np.searchsorted(self.point, np.arange(self.points))

    @property
    def points(self) -> int:
        """Number P of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def sums_by_point(
        self,
        values: Array,  # [..., M]
    ) -> Array:
        """[..., P] sums over each point's observations."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=-1))


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
