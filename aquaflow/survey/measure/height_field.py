"""The ground as heights over square cells, as reef numbers are measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from aquaflow.survey.export.ortho.grid import Grid

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Held:
    """How many pictures show the place of each cell, and how well that is known; [h, w] each."""

    plain: Counts
    narrow: Counts
    """With pictures that end PICTURE_SIGMA_PX earlier on all sides: pose and camera err so much."""
    wide: Counts
    """With pictures that end as much later."""
    raised: Counts
    """With unmapped cells, whose heights are those of the nearest mapped one, one standard
    deviation of the heights higher."""


@dataclass(frozen=True)
class HeightField:
    """A sub-map's ground on the axes of :class:`aquaflow.survey.export.ortho.ground.Ground`."""

    grid: Grid
    """Its pixels are the cells."""
    height: Array
    """[h, w] mean within the cell; NaN where the map has none that two views see."""
    blurred: Array
    """[h, w] the same of heights that were blurred by ``resolution``: what the map's resolution
    does to them once more."""
    sigma: Array
    """[h, w] 1 sigma of the height by rays that are known to 1 pixel; shared by neighbours."""
    held: Held
    resolution: float
    """Distance below which the map does not tell heights apart: the mean one between neighbouring
    Gaussians, or what matches of pictures blur, whichever is larger."""
    reach: float
    """Width of what a picture shows, median: errors within it are largely one."""

    @property
    def cell(self) -> float:
        """Side of a cell."""
        return self.grid.pixel

    @property
    def mapped(self) -> npt.NDArray[np.bool_]:
        """[h, w] True where there is a height."""
        return np.isfinite(self.height)

    def at(
        self,
        places: Array,  # [N, 2] x, y on the ground
    ) -> tuple[Array, Array]:
        """Heights [N] and their sigmas [N], between the centres of cells; NaN where one of the four
        around has none."""
        column = (places[:, 0] - self.grid.left) / self.cell - 0.5
        row = (self.grid.top - places[:, 1]) / self.cell - 0.5
        at = np.stack([row, column])
        found = (
            map_coordinates(each, at, order=1, mode="constant", cval=np.nan)
            for each in (self.height, self.sigma)
        )
        height, sigma = found
        return height, sigma
