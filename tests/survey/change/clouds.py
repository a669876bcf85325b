"""Clouds of known shape, as two days would show them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.survey.change.m3c2 import DayPoints, Scales, SurfaceDistances, m3c2, normals_at

Array = npt.NDArray[np.float64]

SCALES = Scales(normal=0.2, cylinder=0.06, reach=0.5, apart=0.001)
"""Points of these clouds err independently."""


def ground(seed: int, noise: float, height: float = 0.0, count: int = 6000) -> DayPoints:
    """A level square of 2 m with white noise."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-1.0, 1.0, (count, 2))
    z = height + noise * random.standard_normal(count)
    return DayPoints(np.column_stack([xy, z]), np.zeros(count))


def cores(seed: int = 9, count: int = 400) -> Array:
    """Places on the ground."""
    xy = np.random.default_rng(seed).uniform(-0.8, 0.8, (count, 2))
    return np.column_stack([xy, np.zeros(count)])


def compared(
    first: DayPoints, second: DayPoints, places: Array, up: Array, of_surfaces: bool = False
) -> SurfaceDistances:
    """M3C2 with normals of the first cloud, towards ``up``."""
    towards = np.tile(up, (len(first.points), 1))
    normals = normals_at(places, first.points, towards, SCALES.normal)
    return m3c2(first, second, places, normals, SCALES, of_surfaces=of_surfaces)
