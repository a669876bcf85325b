"""A tiled pool: floor and walls of equal tiles round the vehicle's path, with a few objects."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.objects import Rgb, Solid

Array: TypeAlias = npt.NDArray[np.float64]

POOL_MARGIN_M = 1.4
"""Between the vehicle's way and the walls."""
DEPTH_M = 3.2
"""Of the basin: the height of its walls."""
THICKNESS_M = 0.2
"""Of floor and walls."""
TILES_M = (0.12, 0.25)
"""Range of the tiles' edges."""
FLOOR, WALL = (0.52, 0.66, 0.70), (0.66, 0.74, 0.74)
"""Albedo of the glaze, RGB."""
DIRT = (0.38, 0.42, 0.36)
"""Albedo of algae and stains, RGB."""
DIRTY = -0.3
"""``Solid.covered``: algae and stains darken some 3 % of the tiles."""


def corners(
    way: Array,  # [N, 2] m
) -> tuple[Array, Array]:
    """[2] m each: the pool's lower and upper corner in the survey frame."""
    return way.min(axis=0) - POOL_MARGIN_M, way.max(axis=0) + POOL_MARGIN_M


def tiled_basin(
    low: Array,  # [2] m
    high: Array,  # [2] m
    rng: np.random.Generator,
) -> list[Solid]:
    """Floor and four walls between two corners [2] (m); the floor's top is at z = 0."""
    tile = float(rng.uniform(*TILES_M))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    thin, tall = 0.5 * THICKNESS_M, 0.5 * DEPTH_M
    basin = [_slab((*middle, -thin), (half[0], half[1], thin), FLOOR, tile)]
    for side in (-1.0, 1.0):
        x, y = middle[0] + side * (half[0] + thin), middle[1] + side * (half[1] + thin)
        basin.append(_slab((x, middle[1], tall), (thin, half[1], tall), WALL, tile))
        basin.append(_slab((middle[0], y, tall), (half[0], thin, tall), WALL, tile))
    return basin


def _slab(
    centre: tuple[float, float, float], size: tuple[float, float, float], paint: Rgb, tile: float
) -> Solid:
    return Solid("box", np.array(centre), np.eye(3), size, paint, DIRT, DIRTY, tile_m=tile)
