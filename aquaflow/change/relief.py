"""Heights of both days over a plane around some patches: volumes, and how far a thing moved."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import griddata
from scipy.ndimage import shift
from scipy.signal import fftconvolve
from scipy.spatial import ConvexHull, QhullError

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MARGIN_CELLS = 4
"""Around the patches, where the ground is that of both days."""


@dataclass(frozen=True)
class Window:
    """A raster in a plane; heights are along the plane's normal."""

    origin: Array
    """[3] of its first cell's outer corner."""
    axes: Array
    """[3, 3] columns: along the rows' cells, across them, and the normal."""
    cell: float
    shape: tuple[int, int]

    @staticmethod
    def around(
        places: Array,  # [N, 3]
        normal: Array,  # [3]
        cell: float,
    ) -> Window:
        """The raster that holds ``places`` with a margin."""
        up = normal / np.linalg.norm(normal)
        helper = np.eye(3)[int(np.argmin(np.abs(up)))]
        x = np.cross(helper, up) / np.linalg.norm(np.cross(helper, up))
        axes = np.column_stack([x, np.cross(up, x), up])
        local = places @ axes
        margin = MARGIN_CELLS * cell
        low, high = local.min(axis=0) - margin, local.max(axis=0) + margin
        sides = np.maximum(np.ceil((high - low)[:2] / cell), 1).astype(int)
        corner = np.array([low[0], low[1], 0.0])
        return Window(axes @ corner, axes, cell, (int(sides[1]), int(sides[0])))

    def cells(
        self,
        places: Array,  # [N, 3]
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Array, Flags]:
        """Rows, columns and heights [N] of places, and which of them [N] the raster holds."""
        local = (places - self.origin) @ self.axes
        column, row = np.floor(local[:, :2] / self.cell).astype(np.intp).T
        inside = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
        return row, column, local[:, 2], inside

    def mask(
        self,
        places: Array,  # [N, 3]
    ) -> Flags:
        """[h, w] True in cells that hold a place."""
        row, column, _, inside = self.cells(places)
        found = np.zeros(self.shape, bool)
        found[row[inside], column[inside]] = True
        return found

    def heights(
        self,
        points: Array,  # [N, 3]
        reach: tuple[float, float],
    ) -> Array:
        """[h, w] of the highest points between two heights; NaN where there are none."""
        row, column, height, inside = self.cells(points)
        inside &= (height > reach[0]) & (height < reach[1])
        found = np.full(self.shape, -np.inf)
        np.maximum.at(found, (row[inside], column[inside]), height[inside])
        return np.where(np.isfinite(found), found, np.nan)


def filled(
    heights: Array,  # [h, w] NaN: unknown
) -> Array:
    """[h, w] with what is unknown between known cells interpolated, beyond them as the nearest."""
    known = np.isfinite(heights)
    if known.all() or known.sum() < 4:
        return heights
    places, at = np.argwhere(known), np.argwhere(~known)
    values, found = heights[known], heights.copy()
    between = np.full(len(at), np.nan)
    with contextlib.suppress(QhullError):  # all known cells on one line
        between = griddata(places, values, at, method="linear")
    nearest = griddata(places, values, at, method="nearest")
    found[~known] = np.where(np.isfinite(between), between, nearest)
    return found


def hull_of(
    mask: Flags,  # [h, w]
) -> Flags:
    """[h, w] True within the convex hull of the cells of ``mask``."""
    places = np.argwhere(mask)
    try:
        hull = ConvexHull(places)
    except (QhullError, ValueError):
        return mask
    every = np.argwhere(np.ones_like(mask))
    inside = (every @ hull.equations[:, :2].T + hull.equations[:, 2] <= 1e-9).all(axis=1)
    return np.asarray(inside.reshape(mask.shape))


@dataclass(frozen=True)
class Move:
    """From where a thing stood to where it stands, in cells."""

    cells: Array
    """[2] rows, columns."""
    sigma_cells: float
    likeness: float
    """Correlation of the two shapes, at most 1."""


def best_shift(
    before: Array,  # [h, w] height of the thing above the ground; 0 around it
    after: Array,  # [h, w]
    apart_cells: float,
) -> Move:
    """The shift that lays ``before`` onto ``after``: the peak of their correlation, which a
    parabola around it refines; sigma follows from what is left over and the slopes.

    Args:
        apart_cells: distance of cells from which they err independently.
    """
    found = fftconvolve(after, before[::-1, ::-1])
    peak = np.array(np.unravel_index(int(np.argmax(found)), found.shape))
    cells = (peak + _vertex(found, peak)) - (np.array(before.shape) - 1)
    moved = shift(before, cells, order=1)
    norm = float(np.sqrt((moved**2).sum() * (after**2).sum()))
    likeness = float((moved * after).sum()) / norm if norm > 0.0 else 0.0
    slopes = np.stack(np.gradient(moved)).reshape(2, -1)
    thing = (moved > 0.0) | (after > 0.0)
    left = float(np.sqrt(((moved - after)[thing] ** 2).mean())) if thing.any() else 0.0
    least = float(np.linalg.eigvalsh(slopes @ slopes.T)[0])
    sigma = left * apart_cells / np.sqrt(least) if least > 0.0 else np.inf
    return Move(cells, float(sigma), likeness)


def _vertex(
    values: Array,  # [h, w]
    peak: npt.NDArray[np.intp],  # [2]
) -> Array:
    """[2] of a parabola through the peak and its neighbours along each axis, from the peak."""
    found = np.zeros(2)
    for axis in range(2):
        at = [int(peak[0]), int(peak[1])]
        if not 0 < at[axis] < values.shape[axis] - 1:
            continue
        near = []
        for step in (-1, 0, 1):
            place = at.copy()
            place[axis] += step
            near.append(float(values[place[0], place[1]]))
        bend = near[0] - 2.0 * near[1] + near[2]
        if bend < 0.0:
            found[axis] = 0.5 * (near[0] - near[2]) / bend
    return found
