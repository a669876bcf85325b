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
from aquaflow.dive.placement import UPRIGHT_FROM_DOWN, grid_of
from aquaflow.geometry.similarity import Sim3, nearest_rotation
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.survey.export.ortho.shown_views import ShownViews

Array = npt.NDArray[np.float64]

LEAST_VIEWS = 2
"""That see a pixel, or it is a hole: what one view alone sees has no parallax. On the surveys 1 and
7 it is smears along the rim, whose heights are guesses."""
LARGEST_LOOK_DEG = 30.0
"""Between the cameras' mean viewing direction and the normal of what they show, up to which that
plane is taken for the ground, seen squarely. The surveys 1, 3, 6 and 7, which look down, have 14,
4, 2 and 10; the reef clip, which looks ahead, has 61."""
ALONG_GRAVITY = "along gravity"
ACROSS_GROUND = "perpendicular to the mean plane of the ground; gravity is unknown"
"""What the vertical is, in words."""
NO_VERTICAL = (
    "nothing says which way is down; give it by `aquaflow measure level`, or map with the "
    "vehicle's attitude (--telemetry)"
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


def ground_of(frame: WorldFrame, shown: ShownViews) -> Ground:
    """The ground of a sub-map: level where gravity is known, else the mean plane of what its views
    show, where that is one and they look squarely at it.

    Raises:
        InputError: gravity is unknown, and there is no such plane.
    """
    poses = [frame.pose(view.T_wc) for view in shown.mapper.views]
    epsg, corner, grid_scale = None, (0.0, 0.0), 1.0
    if frame.level:
        R_gn, vertical = UPRIGHT_FROM_DOWN, ALONG_GRAVITY
        grid = grid_of(frame)
        if grid is not None:
            middle = np.mean([T_nc.t for T_nc in poses], axis=0)
            epsg = grid.epsg
            turn, grid_scale = grid.axes(middle)
            R_gn = turn @ UPRIGHT_FROM_DOWN
            place = grid.places(middle[None])[0]
            corner = tuple((place - grid_scale * (R_gn @ middle)[:2]).tolist())
    else:
        R_gn, vertical = _on_mean_plane(poses, frame.T_nm.R, shown), ACROSS_GROUND
    return Ground(
        Sim3(R_gn, np.zeros(3)) @ frame.T_nm, frame.unit, epsg, corner, grid_scale,
        _axes_in_words(frame, epsg), vertical, _zero_in_words(frame),
    )  # fmt: skip


def _on_mean_plane(
    poses: list[Sim3],
    R_nm: Array,  # [3, 3]
    shown: ShownViews,
) -> Array:
    """R_gn [3, 3]: up is the normal of what the views show, y is up in the first picture."""
    from aquaflow.survey.export.ortho.shown_views import mean_normal  # loads torch

    normal = mean_normal(shown.points())
    if normal is None:
        raise InputError(f"what the cameras see lies about no plane, and {NO_VERTICAL}")
    up, look = R_nm @ normal, np.mean([T_nc.R[:, 2] for T_nc in poses], axis=0)
    up = -up * np.sign(up @ look)
    aside = np.degrees(np.arccos(min(1.0, -up @ look / max(np.linalg.norm(look), 1e-12))))
    if aside > LARGEST_LOOK_DEG:
        raise InputError(
            f"the cameras look at the ground from {aside:.0f} degrees aside, and {NO_VERTICAL}"
        )
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
