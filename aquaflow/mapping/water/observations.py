"""Surface points as several pictures show them: what the water is estimated from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

MIN_RANGE_RATIO = 1.25
"""Points whose largest range over smallest is below this carry no information."""


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

    @property
    def points(self) -> int:
        """Number P of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0


def mean_by(
    point: Index,  # [M]
    values: Array,  # [M, K]
) -> Array:
    """[P, K] mean over each point's observations."""
    count = np.maximum(np.bincount(point), 1)
    return np.stack([np.bincount(point, column) / count for column in values.T], axis=-1)


def informative(observations: Observations) -> Observations:
    """Only the points that were seen at clearly different ranges, renumbered."""
    count = observations.points
    low, high = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(low, observations.point, observations.z)
    np.maximum.at(high, observations.point, observations.z)
    good = high > MIN_RANGE_RATIO * low
    keep = good[observations.point]
    number = np.cumsum(good) - 1
    return Observations(
        number[observations.point[keep]],
        observations.view[keep],
        observations.colour[keep],
        observations.z[keep],
        observations.xy[keep],
        observations.blend[keep],
    )
