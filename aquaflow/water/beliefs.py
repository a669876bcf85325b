"""Weak priors on the colours of surface points without water."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.config import WaterPriorsConfig
from aquaflow.water.observations import FEWEST, Index

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


# --------------------------------------------------------------------------------------------------
# Regions of the scene are on the whole alike.
#
# What lies far away has on the whole the colours and the contrast of what lies near. Water changes
# both with range: so a single picture tells of it, where no point is seen from near and far. Only
# on the whole, though: sand is not coral. So the scene is cut into regions, each counts once, and
# they may differ by as much as regions of scenes without water do.

LEAST = 5e-3
"""Added to means and contrasts: guards the logarithms of black regions."""
SIGMAS = np.array([[0.7, 0.3, 0.3], [0.7, 0.3, 0.3]])
"""Deviation of a region's log mean (first row) and log contrast (second) from those of all: in
brightness, red over green, blue over green. Twice what regions of clear scenes show, since
neighbouring regions are alike, so that a quarter of them counts."""
OPPONENT = np.array([[1.0, 1.0, 1.0], [3.0, -3.0, 0.0], [0.0, -3.0, 3.0]]) / 3.0
"""Brightness, red over green and blue over green of logarithms of RGB."""


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
