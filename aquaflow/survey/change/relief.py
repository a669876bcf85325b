"""Heights of both days over a plane around some patches: volumes, and how far a thing moved."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import griddata
from scipy.spatial import ConvexHull, QhullError

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MARGIN_CELLS = 4
"""Around the patches, where the ground is that of both days."""


@dataclass(frozen=True)
class ReliefWindow:
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
    ) -> ReliefWindow:
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
        return ReliefWindow(axes @ corner, axes, cell, (int(sides[1]), int(sides[0])))

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

    def at_height(
        self,
        heights: Array,  # [h, w]
    ) -> Array:
        """[h w, 3] the middles of the cells at these heights."""
        row, column = np.indices(self.shape)
        local = np.stack([(column + 0.5) * self.cell, (row + 0.5) * self.cell, heights], axis=-1)
        return np.asarray(local.reshape(-1, 3) @ self.axes.T + self.origin)

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


def fill(
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
    """A move from where a thing stood to where it stands, in cells."""

    cells: Array
    """[2] rows, columns."""
    sigma_cells: float
    likeness: float
    """Mean correlation of heights and of brightness, at most 1."""


def best_shift(
    before: Array,  # [L, h, w] layers of the first day: heights, brightness
    after: Array,  # [L, h, w] the same of the second
    thing: Flags,  # [h, w] cells of the first day that it covers
    most: int,
) -> Move:
    """The shift, of ``most`` cells at most along each axis, by which the thing's cells look most
    alike on both days: the peak of the mean correlation of the layers, refined by a parabola.

    Its sigma is the way on which that mean falls by its standard error, (1 - r^2) / sqrt(n).
    """
    at, shape = np.argwhere(thing), np.array(thing.shape)
    own = _standard(before[:, at[:, 0], at[:, 1]])
    found = np.full((2 * most + 1, 2 * most + 1), -1.0)
    for row, column in np.ndindex(found.shape):
        places = at + np.array([row - most, column - most])
        inside = (places >= 0).all(axis=1) & (places < shape).all(axis=1)
        if inside.all():
            there = _standard(after[:, places[:, 0], places[:, 1]])
            found[row, column] = float((own * there).mean())
    peak = np.array(np.unravel_index(int(np.argmax(found)), found.shape))
    offset, bend = _vertex(found, peak)
    likeness = float(found[tuple(peak)])
    error = (1.0 - likeness**2) / np.sqrt(max(1, len(at)))
    sigma = float(np.sqrt(2.0 * error / bend)) if bend > 0.0 else np.inf
    return Move(peak - most + offset, sigma, likeness)


def _standard(
    values: Array,  # [L, n]
) -> Array:
    """[L, n] of mean 0 and variance 1; 0 where all are alike."""
    centred = values - values.mean(axis=1, keepdims=True)
    spread = centred.std(axis=1, keepdims=True)
    return np.asarray(np.where(spread > 0.0, centred / np.where(spread > 0.0, spread, 1.0), 0.0))


def _vertex(
    values: Array,  # [h, w]
    peak: npt.NDArray[np.intp],  # [2]
) -> tuple[Array, float]:
    """[2] of a parabola through the peak and its neighbours along each axis, from the peak, and
    the smaller of its two bends; 0 at the raster's edge."""
    found, bends = np.zeros(2), []
    for axis in range(2):
        at = [int(peak[0]), int(peak[1])]
        if not 0 < at[axis] < values.shape[axis] - 1:
            return np.zeros(2), 0.0
        near = []
        for step in (-1, 0, 1):
            place = at.copy()
            place[axis] += step
            near.append(float(values[place[0], place[1]]))
        bends.append(2.0 * near[1] - near[0] - near[2])
        if bends[-1] > 0.0:
            found[axis] = -0.5 * (near[0] - near[2]) / bends[-1]
    return found, min(bends)
