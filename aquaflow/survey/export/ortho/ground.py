"""The ground that a raster lies on: which way is up, and what its coordinates mean.

Ground axes g are x to the right in the raster, y up in it, z the height above it; lengths are
metres where the dive's are, else map units. Raster coordinates are those of a UTM zone where the
dive is georeferenced, else the ground's own x and y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.placement import Placement, placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper

Array = npt.NDArray[np.float64]

LEAST_VIEWS = 2
"""That see a pixel, or it is a hole: what one view alone sees has no parallax. On the surveys 1 and
7 it is smears along the rim, whose heights are guesses."""
ALONG_GRAVITY = "along gravity"
ACROSS_GROUND = "perpendicular to the mean plane of the ground; gravity is unknown"
"""What the vertical is, in words."""
NO_VERTICAL = (
    "the cameras look squarely at no plane ground, and nothing says which way is down; give it by "
    "`aquaflow measure level`, or map with the vehicle's attitude (--telemetry)"
)

OVERVIEW = "overview.png"
"""The map from above, in a dive's folder."""
NO_OVERVIEW = "no map from above was drawn"
"""Begins the note that says why."""


@dataclass(frozen=True)
class Ground:
    """From a sub-map's world to the ground, and from there to raster coordinates."""

    T_gm: Sim3
    """Its scale is that of ``WorldFrame.T_nm``."""
    where: Placement
    """Of what the raster lies over: points, meshes."""
    origin: tuple[float, float]
    """Raster coordinates of x = y = 0."""
    grid_scale: float
    """Lengths in the raster over lengths in g; within 0.1 % of 1 in a UTM zone."""
    vertical: str
    height_zero: str
    """What the direction of z and z = 0 are, in words."""

    @property
    def unit(self) -> str:
        """Of lengths in g and of heights: ``m`` or ``map units``."""
        return self.where.unit

    @property
    def epsg(self) -> int | None:
        """Of the raster's coordinates; None: they are x and y of g."""
        return self.where.epsg

    @property
    def axes(self) -> str:
        """What the raster's coordinates and its heights are, in words."""
        return self.where.in_words()

    def pose(self, T_mc: Sim3) -> Sim3:
        """T_gc of a camera, rigid."""
        T = self.T_gm @ T_mc
        return Sim3(T.R, T.t)


def ground_of(frame: WorldFrame, mapper: Mapper) -> Ground:
    """The ground of a sub-map: the upright frame of all exports, turned to its grid where it has
    one.

    Raises:
        InputError: nothing says which way is up.
    """
    if not frame.has_vertical:
        raise InputError(NO_VERTICAL)
    where = placement(frame)
    R_gn, corner, grid_scale = where.T_un.R, (0.0, 0.0), 1.0
    if where.grid is not None:
        middle = np.mean([frame.pose(view.T_wc).t for view in mapper.views], axis=0)
        turn, grid_scale = where.grid.axes(middle)
        R_gn = turn @ R_gn
        place = where.grid.places(middle[None])[0]
        corner = tuple((place - grid_scale * (R_gn @ middle)[:2]).tolist())
    return Ground(
        Sim3(R_gn, np.zeros(3)) @ frame.T_nm, where, corner, grid_scale,
        ALONG_GRAVITY if frame.level else ACROSS_GROUND,
        "the water surface" if frame.level and frame.depth_known else "the dive's start",
    )  # fmt: skip
