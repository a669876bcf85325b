"""Height fields of ground that is known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from aquaflow.survey.export.ortho.grid import Grid
from aquaflow.survey.measure.height_field import HeightField, Held

Array = npt.NDArray[np.float64]

CELL = 0.1


def field(
    height: Callable[[Array, Array], Array],
    side: float = 6.0,
    sigma: float = 0.0,
    blurred: Callable[[Array, Array], Array] | None = None,
) -> HeightField:
    """A square of ``side`` with its corner in the origin, all of it seen by five pictures."""
    count = round(side / CELL)
    grid = Grid(0.0, side, CELL, count, count)
    places = (np.arange(count) + 0.5) * CELL
    x, y = np.meshgrid(places, places[::-1])
    heights = height(x, y)
    softer = heights.copy() if blurred is None else blurred(x, y)
    five = np.full(heights.shape, 5, np.int32)
    held = Held(five, five, five, five)
    return HeightField(grid, heights, softer, np.full(heights.shape, sigma), held, 0.03, 2.0)
