"""A length that is known in metres and was measured in the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.robust import sigma_of

Array = npt.NDArray[np.float64]

LARGEST_DEVIATION = 3.5
"""Sigmas from the median beyond which one of three or more lengths contradicts the others."""


@dataclass(frozen=True)
class KnownLength:
    """Its ratio ``length_m / map_length`` is the scale of the map."""

    frame_index: int
    """Frame that it was measured in, or the nearest of several; -1: marked in the map itself."""
    source: str
    """What it is: ``marker 17``, ``laser dots``, ``scale bar``."""
    map_length: float
    map_sigma: float
    """Length in the map and its 1 sigma, map units."""
    length_m: float
    sigma_m: float
    """True length and its 1 sigma, metres."""
    sub_map: int = 0
    """Number of the sub-map that it was marked in."""

    @property
    def metres_per_unit(self) -> float:
        """The scale that follows from this length alone."""
        return self.length_m / self.map_length

    @property
    def relative_sigma(self) -> float:
        """1 sigma of ``metres_per_unit``, relative."""
        return float(np.hypot(self.map_sigma / self.map_length, self.sigma_m / self.length_m))


@dataclass(frozen=True)
class LengthScale:
    """The scale of one sub-map by all its known lengths."""

    metres_per_unit: float
    """Weighted mean of the lengths."""
    relative_sigma: float
    """1 sigma of it, relative."""
    used: int
    """Number of lengths that agree."""
    rejected: tuple[KnownLength, ...]
    """Lengths that contradict the others."""


def scale_of(lengths: Sequence[KnownLength]) -> LengthScale | None:
    """The weighted mean of the lengths of one sub-map, in the logarithm; None without any.

    Where they scatter by more than they state, their sigma grows with it: two that contradict each
    other leave the scale as uncertain as they are apart.
    """
    if not lengths:
        return None
    logs = np.log([length.metres_per_unit for length in lengths])
    sigmas = np.array([length.relative_sigma for length in lengths])
    good = np.ones(len(lengths), bool)
    if len(lengths) > 2:
        spread = max(sigma_of(logs - np.median(logs)), 1e-12)
        allowed = LARGEST_DEVIATION * np.maximum(sigmas, spread)
        good = np.abs(logs - np.median(logs)) <= allowed
    weights = 1.0 / sigmas[good] ** 2
    mean = float(weights @ logs[good] / weights.sum())
    sigma = float(1.0 / np.sqrt(weights.sum()))
    if good.sum() > 1:
        chi_square = float(weights @ (logs[good] - mean) ** 2)
        sigma *= max(1.0, float(np.sqrt(chi_square / (good.sum() - 1))))
    rejected = tuple(length for length, kept in zip(lengths, good, strict=True) if not kept)
    return LengthScale(float(np.exp(mean)), sigma, int(good.sum()), rejected)
