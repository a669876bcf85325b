"""Patches of the scene's surface in several pictures: what the water is estimated from."""

from __future__ import annotations

from collections.abc import Generator, Sequence
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
# Regions of the scene, and what is known of their colours before anything is seen.
#
# What lies far away has on the whole the colours and the contrast of what lies near. Water changes
# both with range: so a single picture tells of it, where no point is seen from near and far. Only
# on the whole, though: sand is not coral. So the scene is cut into regions, each counts once, and
# they may differ by as much as regions of scenes without water do.

DEPTH = 5
"""Times that the scene is halved: 32 regions, so that some are near and some far on any dive, and
each is large enough to have little to do with the next."""
FEWEST = 8
"""Points of a region whose mean and contrast are known well enough to be compared."""
LEAST = 5e-3
"""Added to means and contrasts: guards the logarithms of black regions."""
SIGMAS = np.array([[0.7, 0.3, 0.3], [0.7, 0.3, 0.3]])
"""Deviation of a region's log mean (first row) and log contrast (second) from those of all: in
brightness, red over green, blue over green. Twice what regions of clear scenes show, since
neighbouring regions are alike, so that a quarter of them counts."""
OPPONENT = np.array([[1.0, 1.0, 1.0], [3.0, -3.0, 0.0], [0.0, -3.0, 3.0]]) / 3.0
"""Brightness, red over green and blue over green of logarithms of RGB."""


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


class RegionalColours:
    """How far regions' colours are from those of all regions, whitened, with derivatives."""

    def __init__(
        self,
        region: Index,  # [P]
    ) -> None:
        members = region == np.arange(int(region.max(initial=-1)) + 1)[:, None]
        count = members.sum(axis=1)
        kept = count >= FEWEST
        self._average = (members / np.maximum(count, 1)[:, None])[kept]
        """[R, P] takes values of points to their means over regions."""
        self._region = np.where(kept[region], (np.cumsum(kept) - 1)[region], 0)
        """[P] number among the kept; 0 for points of none, which no mean counts."""
        self.number = len(self._average)
        """Regions with enough points."""

    def residuals(
        self,
        J: Array,  # [3, P] colours without water
    ) -> Array:
        """[6 R]: of all regions brightness, red and blue, of means and then of contrasts."""
        if self.number == 0:
            return np.zeros(0)
        mean, deviation, _ = self._moments(J)
        return self._whiten(np.log(np.stack([mean, deviation]) + LEAST)).reshape(-1)

    def rows(
        self,
        J: Array,  # [3, P]
        changes: Sequence[tuple[Index, Array]],  # of each channel: parameters [k], J's [k, P]
        size: int,
    ) -> Array:
        """[6 R, size] derivatives by all parameters."""
        if self.number == 0:
            return np.zeros((0, size))
        mean, deviation, centred = self._moments(J)
        logs = np.zeros((2, 3, self.number, size))
        for c, (own, by_J) in enumerate(changes):
            of_mean = self._average @ by_J.T
            of_deviation = self._average @ (centred[c] * by_J).T
            of_deviation /= np.maximum(deviation[c], LEAST)[:, None]
            logs[0, c][:, own] = of_mean / (mean[c] + LEAST)[:, None]
            logs[1, c][:, own] = of_deviation / (deviation[c] + LEAST)[:, None]
        return self._whiten(logs).reshape(6 * self.number, size)

    def _whiten(
        self,
        logs: Array,  # [2, 3, R, ...] of RGB
    ) -> Array:
        apart = np.einsum("oc,scr...->sor...", OPPONENT, logs)
        apart = apart - apart.mean(axis=2, keepdims=True)
        sigmas = SIGMAS.reshape(2, 3, *[1] * (logs.ndim - 2))
        return np.asarray(apart / sigmas)

    def _moments(
        self,
        J: Array,  # [3, P]
    ) -> tuple[Array, Array, Array]:
        """Mean [3, R], deviation [3, R], and how far each point is from the mean [3, P]."""
        mean = J @ self._average.T
        centred = J - mean[:, self._region]
        return mean, np.sqrt(centred**2 @ self._average.T), centred
