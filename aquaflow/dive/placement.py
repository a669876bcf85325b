"""Coordinates of what other programs get: z up, and on the UTM grid where the earth is known.

The upright frame u has the origin and the unit of n (docs/conventions.md#world-n). Where gravity is
known its axes are right, forward and up of what n's x axis points to: east, north, up where that is
true north. Where nothing is known they are those of the first keyframe's camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.dive.utm_grid import UtmGrid, grid_of
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

UPRIGHT_FROM_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Right, forward, up from forward, right, down."""
UPRIGHT_FROM_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Right, forward, up from right, down, forward."""


@dataclass(frozen=True)
class Placement:
    """Where the exported points of one sub-map lie."""

    T_un: Sim3
    """From n to the upright frame: a rotation alone."""
    unit: str
    """``m`` or ``map units``."""
    axes: str
    """The upright frame in words."""
    grid: UtmGrid | None = None
    """Where the points are laid on one."""

    @property
    def epsg(self) -> int | None:
        """Of the grid; None where there is none."""
        return None if self.grid is None else self.grid.epsg

    def on_grid(
        self,
        points_u: Array,  # [N, 3] unit, upright frame
    ) -> Array:
        """[N, 3] easting, northing and height (m) in the UTM zone; unchanged where there is none.

        The height is that above z = 0 of n.
        """
        if self.grid is None:
            return points_u
        places = self.grid.places(self.T_un.inverse().apply(points_u))
        return np.column_stack([places, points_u[:, 2]])

    def turned_to_grid(
        self,
        directions_u: Array,  # [N, 3] upright frame
    ) -> Array:
        """[N, 3] the same directions against the grid's north in place of the true one."""
        if self.grid is None:
            return directions_u
        return np.asarray(directions_u @ self.grid.axes(np.zeros(3))[0].T)

    def wkt(self) -> str | None:
        """The grid's coordinate reference system in OGC WKT 1, as LAS 1.4 demands; or None."""
        return None if self.grid is None else self.grid.wkt()

    def in_words(self) -> str:
        """Axes, unit and grid of exported points, in one line."""
        if self.epsg is None:
            return f"{self.axes}; {self.unit}"
        return f"EPSG:{self.epsg}, x easting, y northing, z up; m"


def placement(frame: WorldFrame) -> Placement:
    """The placement of the sub-map that ``frame`` belongs to."""
    if frame.north == "first keyframe":
        R, axes = UPRIGHT_FROM_CAMERA, "x right, y forward, z up of the first keyframe's camera"
    elif frame.north == "true north":
        R, axes = UPRIGHT_FROM_DOWN, "x east, y north, z up"
    else:
        R, axes = UPRIGHT_FROM_DOWN, f"y {frame.north}, x to the right of it, z up"
    T_un = Sim3(R, np.zeros(3), 1.0)
    return Placement(T_un, frame.unit, axes, grid_of(frame))
