"""The ground that a raster lies on: which way is up, and what its coordinates mean.

Ground axes g are x to the right in the raster, y up in it, z the height above it; lengths are
metres where the dive's are, else map units. Raster coordinates are those of a UTM zone where the
dive is georeferenced, else the ground's own x and y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.placement import UPRIGHT_FROM_DOWN, grid_of
from aquaflow.geometry.similarity import Sim3, nearest_rotation
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.render.views import View

Array = npt.NDArray[np.float64]

LEAST_VIEWS = 2
"""That see a pixel, or it is a hole: what one view alone sees has no parallax. On the surveys 1 and
7 it is smears along the rim, whose heights are guesses."""
LEAST_AGREEMENT = 0.5
"""Length of the mean of the views' unit axes; at 0.5 they spread over a half-angle of 90 degrees,
and no direction is below all of them."""


@dataclass(frozen=True)
class Ground:
    """From a sub-map's world to the ground, and from there to raster coordinates."""

    T_gm: Sim3
    """Its scale is that of ``WorldFrame.T_nm``."""
    unit: str
    """Of lengths in g and of heights: ``m`` or ``map units``."""
    epsg: int | None
    """Of the raster's coordinates; None: they are x and y of g."""
    origin: tuple[float, float]
    """Raster coordinates of x = y = 0."""
    grid_scale: float
    """Lengths in the raster over lengths in g; within 0.1 % of 1 in a UTM zone."""
    axes: str
    vertical: str
    height_zero: str
    """What axes, direction of z and z = 0 are, in words."""

    def pose(self, T_mc: Sim3) -> Sim3:
        """T_gc of a camera, rigid."""
        T = self.T_gm @ T_mc
        return Sim3(T.R, T.t)


def ground_of(frame: WorldFrame, views: Sequence[View]) -> Ground:
    """The ground of a sub-map.

    Raises:
        InputError: gravity is unknown, and the views look in all directions.
    """
    poses = [frame.pose(view.T_wc) for view in views]
    middle = np.mean([T_nc.t for T_nc in poses], axis=0)
    epsg, corner, grid_scale = None, (0.0, 0.0), 1.0
    if frame.level:
        R_gn, vertical = UPRIGHT_FROM_DOWN, "along gravity"
        grid = grid_of(frame)
        if grid is not None:
            epsg = grid.epsg
            turn, grid_scale = grid.axes(middle)
            R_gn = turn @ UPRIGHT_FROM_DOWN
            place = grid.places(middle[None])[0]
            corner = tuple((place - grid_scale * (R_gn @ middle)[:2]).tolist())
    else:
        R_gn, vertical = _below_views(poses), "against the mean viewing direction of the cameras"
    return Ground(
        Sim3(R_gn, np.zeros(3)) @ frame.T_nm, frame.unit, epsg, corner, grid_scale,
        _axes_in_words(frame, epsg), vertical, _zero_in_words(frame),
    )  # fmt: skip


def _below_views(poses: Sequence[Sim3]) -> Array:
    """R_gn [3, 3]: up is against the mean viewing direction, y is up in the pictures."""
    axes = np.mean([T_nc.R for T_nc in poses], axis=0)
    if np.linalg.norm(axes[:, 2]) < LEAST_AGREEMENT:
        raise InputError(
            "nothing says which way is up in this dive, and its cameras look in all directions; "
            "map it with the vehicle's attitude (--telemetry)"
        )
    up = -axes[:, 2] / np.linalg.norm(axes[:, 2])
    # A survey's lines go there and back, so that only the first picture's top is sure to exist.
    y = -poses[0].R[:, 1]
    y = y - up * (up @ y)
    y /= np.linalg.norm(y)
    return nearest_rotation(np.array([np.cross(y, up), y, up]))


def _axes_in_words(frame: WorldFrame, epsg: int | None) -> str:
    if epsg is not None:
        return f"easting and northing of EPSG:{epsg}, m"
    if frame.level:
        return f"y towards {frame.north}, x to the right of it, {frame.unit}, from the dive's start"
    return f"y up in the dive's first picture, x to the right of it, {frame.unit}"


def _zero_in_words(frame: WorldFrame) -> str:
    if frame.level and frame.depth_known:
        return "the water surface"
    return "the dive's start"
