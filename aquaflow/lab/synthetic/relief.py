"""Relief of the sea floor: a height map with the colours of what covers it.

Heights are metres upward from the mean floor, on a grid of cells whose centres lie at
``origin + (index + 0.5) * cell`` in the survey frame (x along columns, y along rows).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from aquaflow.lab.synthetic.noise import FloatMap

Array: TypeAlias = npt.NDArray[np.float64]
SIZE_MULTIPLE = 16
"""Rows and columns are multiples of this, so that five mip levels of the texture divide evenly."""


@dataclass(frozen=True)
class Area:
    """The rectangle of sea floor that a dive sees."""

    x0: float
    y0: float
    cell: float
    """m"""
    shape: tuple[int, int]
    """Rows (y), columns (x)."""

    @classmethod
    def around(
        cls,
        low: Array,  # [2] x, y, m
        high: Array,  # [2] x, y, m
        cell: float,
    ) -> Area:
        """The area from ``low`` to ``high`` ([2] m), rounded up."""
        count = [
            SIZE_MULTIPLE * math.ceil((high[k] - low[k]) / (cell * SIZE_MULTIPLE)) for k in (1, 0)
        ]
        return cls(float(low[0]), float(low[1]), cell, (count[0], count[1]))

    def sample(
        self,
        values: FloatMap,  # [rows, columns] at the cells' centres
        xy: Array,  # [N, 2] m, survey frame
    ) -> Array:
        """Bilinear ``values`` at points [N, 2] (m), clamped to the area."""
        at = [(xy[:, 1] - self.y0) / self.cell - 0.5, (xy[:, 0] - self.x0) / self.cell - 0.5]
        return np.asarray(map_coordinates(values, at, order=1, mode="nearest"), np.float64)


@dataclass
class Relief:
    """Height and what covers it."""

    area: Area
    height: FloatMap
    """[H, W] m, up."""
    tint: FloatMap
    """[H, W, 3] albedo of stamped objects."""
    cover: FloatMap
    """[H, W] 0 (sediment) to 1 (rock, coral)."""
