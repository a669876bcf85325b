"""The plan view of one sub-map at a moment: arrays that any thread may keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import CoverageConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.classes import Classes, CoverageClass, classify, near_bins
from aquaflow.survey.coverage.footprint import Footprint
from aquaflow.survey.coverage.raster import TILE, GridFrame, Tiles, cells_seen

Array = npt.NDArray[np.float64]

MOST_SIDE = 1024
"""Cells along a side of a plan; of a larger area each cell of the plan is one of several."""


AT_ONCE = 256
"""Tiles that are classified at once: 3 MB of counts."""


@dataclass(frozen=True)
class CoveragePlan:
    """Cells of a plane: row i is the i-th along y, column j the j-th along x."""

    frame: GridFrame
    """x to the right on the page, y up, z towards who looks at it; map units."""
    corner: tuple[float, float]
    """x and y of the corner of cell [0, 0], map units in the grid's frame."""
    cell: float
    """Side of the plan's cells, map units; where it is not ``frame.cell``, each cell is one of
    several."""
    classes: Classes
    """[H, W] of :class:`CoverageClass`."""
    views: npt.NDArray[np.uint16]
    """[H, W] keyframes that see the cell, from any range."""
    directions: npt.NDArray[np.uint8]
    """[H, W] different directions among them, at most 17."""
    nearest: npt.NDArray[np.float32]
    """[H, W] map units; range of the nearest view, to 19 %; infinite where there is none."""
    limit: float | None
    """Range beyond which the water is too much, map units; None where no water is known."""
    cells: dict[CoverageClass, int]
    """Cells of side ``frame.cell`` of each class, of the whole grid."""

    def area(self, seen: CoverageClass) -> float:
        """Area of a class, in square map units."""
        return self.cells.get(seen, 0) * self.frame.cell**2

    def places(
        self,
        points_m: Array,  # [..., 3] in the sub-map's world
    ) -> Array:
        """[..., 2] x and y in the grid's frame."""
        return np.asarray(points_m @ self.frame.R_gm[:2].T)

    def classes_of(
        self,
        points_m: Array,  # [..., 3] in the sub-map's world
    ) -> Classes:
        """[...] the :class:`CoverageClass` of the cells that points lie above or below."""
        return self.classes_at(self.places(points_m))

    def classes_at(
        self,
        places: Array,  # [..., 2] in the grid's frame
    ) -> Classes:
        """[...] the :class:`CoverageClass` at places of the plane; NOT where they are off it."""
        j, i = np.moveaxis(np.floor((places - self.corner) / self.cell).astype(np.int64), -1, 0)
        rows, columns = self.classes.shape
        inside = (i >= 0) & (j >= 0) & (i < rows) & (j < columns)
        found = np.zeros(inside.shape, np.uint8)
        found[inside] = self.classes[i[inside], j[inside]]
        return found

    def page(self, T_nm: Sim3, axes: Array) -> Array:  # axes: [2, 3] as from page_axes
        """[2, 3] affine map from the grid's frame to the page: right and up, in n's unit."""
        turn = axes @ T_nm.R @ self.frame.R_gm.T
        return np.column_stack([T_nm.scale * turn[:, :2], axes @ T_nm.t])


def plan_of(
    layer: CoverageLayer, limit: float | None, config: CoverageConfig
) -> CoveragePlan | None:
    """The plan of a grid, with ``limit``, map units, as the water's range; None of an empty one."""
    tiles, frame = dict(layer.tiles.tiles), layer.frame
    if not tiles:
        return None
    places = np.array(list(tiles))
    low, high = places.min(axis=0), places.max(axis=0) + 1
    step = max(1, int(np.ceil((high - low).max() * TILE / MOST_SIDE)))
    step = 1 << (step - 1).bit_length()  # a divisor of a tile's side, or a multiple of it
    per_tile = max(1, TILE // step)
    columns, rows = ((high - low) * TILE) // step + 1
    classes = np.zeros((rows, columns), np.uint8)
    views, directions = np.zeros_like(classes, np.uint16), np.zeros_like(classes)
    nearest = np.full(classes.shape, np.inf, np.float32)
    near, ends = near_bins(frame, limit), frame.bin_ends().astype(np.float32)
    ends[-1] = ends[-2] * 2.0**0.25  # a range that is stated, of what has no bound
    counts = np.zeros(len(CoverageClass), np.int64)
    for first in range(0, len(places), AT_ONCE):
        some = places[first : first + AT_ONCE]
        chosen = [tiles[int(x), int(y)] for x, y in some]
        by_range = np.stack([tile.by_range for tile in chosen])
        by_direction = np.stack([tile.by_direction for tile in chosen])
        whole = classify(by_range, by_direction, near, config)
        counts += np.bincount(whole.ravel(), minlength=len(CoverageClass))
        by_range = by_range[:, ::step, ::step]
        count = by_range.sum(axis=3, dtype=np.uint16)
        sides = (by_direction[:, ::step, ::step] > 0).sum(axis=3, dtype=np.uint8)
        smallest = np.where(count > 0, ends[(by_range > 0).argmax(axis=3)], np.inf)
        for k, (j, i) in enumerate(((some - low) * TILE) // step):
            at = np.s_[i : i + per_tile, j : j + per_tile]
            classes[at], views[at] = whole[k, ::step, ::step].T, count[k].T
            directions[at], nearest[at] = sides[k].T, smallest[k].T
    counts[CoverageClass.NOT] = 0  # of a plane without bounds
    corner = low * TILE * frame.cell
    return CoveragePlan(
        frame, (float(corner[0]), float(corner[1])), step * frame.cell, classes, views, directions,
        nearest, limit, {seen: int(counts[seen]) for seen in CoverageClass},
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# One grid and the keyframes that are counted in it, each with the pose that it was counted by.

Sight = tuple[Footprint, Sim3]
"""A footprint and T_mc."""


class CoverageLayer:
    """Counts that are at any time those of the keyframes in ``drawn``, whatever came before."""

    def __init__(self, frame: GridFrame) -> None:
        self.frame = frame
        self.tiles = Tiles()
        self.drawn: dict[int, Sight] = {}
        """By the keyframe's number."""

    def draw(self, number: int, seen: Sight | None) -> None:
        """Count a keyframe as ``seen``, in place of how it was counted; None: no more."""
        before = self.drawn.pop(number, None)
        if before is not None:
            self.tiles.remove(cells_seen(*before, self.frame))
        if seen is not None:
            self.tiles.add(cells_seen(*seen, self.frame))
            self.drawn[number] = seen
