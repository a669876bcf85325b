"""Patches of the scene's surface in several pictures: what the water is estimated from."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from aquaflow.water.tone import lightness

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

OPEN_WATER_ERROR = 2.0
"""Standard deviation of open water's errors over that of a patch: what looks open may be ground
that is dim and far. Taken at its word, beta_a of murky rendered dives was 5 to 10 % too small."""
APART, FEWEST_APART = 1.25, 20
"""Ratio of ranges from which a point was seen from near and from far; and how many such points tell
how light the ground is from both."""
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
    ray: Array | None = None
    """[M, 3] unit, camera axes, where it is seen; None: not known, nor is the light of lamps but at
    the camera."""
    normal: Array | None = None
    """[M, 3] unit, camera axes, of the surface."""

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
        """Median range of the surface, map units."""
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


def lightness_over_range(
    observations: Observations,
    colours: Array,  # [M, 3] of the same observations, as on a screen (sRGB)
) -> float | None:
    """Mean L* (CIELAB) of the points that were seen from near and far as the farthest view has it
    over that of the nearest; None with too few of them."""
    seen = observations
    by_range = np.lexsort((seen.z, seen.point))
    near, far = by_range[seen.starts], by_range[np.append(seen.starts[1:], len(seen.z)) - 1]
    apart = seen.z[far] > APART * seen.z[near]
    if apart.sum() < FEWEST_APART:
        return None
    L = lightness(colours)
    return float(L[far[apart]].mean() / max(L[near[apart]].mean(), 1.0))


# --------------------------------------------------------------------------------------------------
# Means of values that belong together: a point's observations, a region's points.


def mean_by(
    group: Index,  # [M] number of each value's group
    values: Array,  # [M, K]
) -> Array:
    """[G, K] mean over each group; 0 for one without values."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=-1)


# --------------------------------------------------------------------------------------------------
# Computations with pauses: generators that yield every few milliseconds, so that no frame waits
# for the whole of them.

Result = TypeVar("Result")

PICTURES_AT_ONCE = 4
"""Pictures worked on between two pauses: each takes 2 to 5 ms."""


def run_to_end(steps: Generator[None, None, Result]) -> Result:
    """What a computation with pauses ends with, its pauses left out."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: Result = end.value
            return result


# --------------------------------------------------------------------------------------------------
# Regions of the scene.

DEPTH = 5
"""Times that the scene is halved: 32 regions, so that some are near and some far on any dive, and
each is large enough to have little to do with the next."""
FEWEST = 8
"""Points of a region whose mean and contrast are known well enough to be compared."""


def regions_of(
    positions: Array,  # [P, 3] world
) -> Index:
    """[P] number of each point's region: as many points in each, cut across the widest side."""
    region = np.zeros(len(positions), np.int64)
    for _ in range(DEPTH):
        halves = np.zeros_like(region)
        for number in range(int(region.max(initial=0)) + 1):
            members = np.nonzero(region == number)[0]
            if len(members) < 2 * FEWEST:
                continue
            inside = positions[members]
            side = int(np.argmax(np.ptp(inside, axis=0)))
            order = np.argsort(inside[:, side], kind="stable")
            halves[members[order[len(members) // 2 :]]] = 1
        region = np.unique(2 * region + halves, return_inverse=True)[1].reshape(-1)
    return region
