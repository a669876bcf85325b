"""Regions of the scene, and what is known of their colours before anything is seen.

What lies far away has on the whole the colours and the contrast of what lies near. Water changes
both with range: so a single picture tells of it, where no point is seen from near and far. Only on
the whole, though: sand is not coral. So the scene is cut into regions, each counts once, and they
may differ by as much as regions of scenes without water do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.water.grouping import mean_by

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

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
        count = np.bincount(region)
        self._kept = count >= FEWEST
        self._region = region
        self.number = int(self._kept.sum())
        """Regions with enough points."""

    def residuals(
        self,
        J: Array,  # [3, P] colours without water
    ) -> Array:
        """[6 R]: of all regions brightness, red and blue, of means and then of contrasts."""
        logs = np.stack([self._statistics(J[c]) for c in range(3)], axis=1)  # [2, 3, R]
        return self._whitened(logs).reshape(-1)

    def rows(
        self,
        J: Array,  # [3, P]
        changes: Sequence[tuple[Index, Array]],  # of each channel: parameters [k], J's [k, P]
        size: int,
    ) -> Array:
        """[6 R, size] derivatives by all parameters."""
        logs = np.zeros((2, 3, self.number, size))
        for c, (own, by_J) in enumerate(changes):
            logs[:, c][:, :, own] = self._slopes(J[c], by_J)
        return self._whitened(logs).reshape(-1, size)

    def _whitened(
        self,
        logs: Array,  # [2, 3, R, ...] of RGB
    ) -> Array:
        apart = np.einsum("oc,scr...->sor...", OPPONENT, logs)
        apart = apart - apart.mean(axis=2, keepdims=True)
        sigmas = SIGMAS.reshape(2, 3, *[1] * (logs.ndim - 2))
        return np.asarray(apart / sigmas)

    def _statistics(
        self,
        J: Array,  # [P]
    ) -> Array:
        """[2, R] log of mean and contrast."""
        mean, deviation = self._moments(J)
        return np.log(np.stack([mean, deviation])[:, self._kept] + LEAST)

    def _moments(
        self,
        J: Array,  # [P]
    ) -> tuple[Array, Array]:
        mean = mean_by(self._region, J[:, None])[:, 0]
        square = mean_by(self._region, (J - mean[self._region])[:, None] ** 2)[:, 0]
        return mean, np.sqrt(square)

    def _slopes(
        self,
        J: Array,  # [P]
        by_J: Array,  # [k, P]
    ) -> Array:
        """[2, R, k] derivatives of the statistics."""
        mean, deviation = self._moments(J)
        centred = J - mean[self._region]
        of_mean = mean_by(self._region, by_J.T)
        of_square = mean_by(self._region, (centred * by_J).T)
        of_deviation = of_square / np.maximum(deviation, LEAST)[:, None]
        slopes = np.stack([of_mean, of_deviation])
        levels = np.stack([mean, deviation])[..., None] + LEAST
        return np.asarray((slopes / levels)[:, self._kept])
