"""A height field from the Gaussians of a map, drawn from straight above tile by tile."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, gaussian_filter

from aquaflow.base.errors import InputError
from aquaflow.dive.shown_views import ShownViews
from aquaflow.survey.export.ortho.drawing import MOST_FINER, GroundSplats
from aquaflow.survey.export.ortho.grid import Grid
from aquaflow.survey.export.ortho.ground import LEAST_VIEWS, Ground
from aquaflow.survey.export.ortho.sightings import PICTURE_SIGMA_PX, ViewRanges
from aquaflow.survey.measure.height_field import Array, Counts, HeightField, Held
from aquaflow.water.sightings import SOLID

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""

PARTS = 4
"""Drawn cells along a cell; 4 leaves 16 heights to its mean."""
MATCH_PX = 4.0
"""Pixels on the ground that err together, and so are not told apart: half a patch of the optical
flow (OpenCV's DIS: 8 x 8), from which depths are triangulated."""
CELL_RESOLUTIONS = 3.0
"""Least side of a cell that is found, in resolutions of the map. On the synthetic reef of
notes/2026-11-survey.md#reef-numbers rugosity is 4 % low at 3.3 of them and 7 % at 1.6."""
STEPS = (1.0, 2.0, 5.0)
"""Sides of cells that are found, times powers of ten: dives of one kind get the same."""
BIN_FOOTPRINTS = 16.0
"""Side of the bins in which Gaussians are counted, in pixels of the pictures on the ground."""
LEAST_FILLED = 0.5
"""Share of a cell that the map covers where the cell has a height."""
MOST_CELLS = 1 << 22
"""One hectare of 5 cm; the arrays of more take more than half a gigabyte."""


def draw_heights(
    shown: ShownViews,
    ground: Ground,
    work: Path,
    cell: float | None = None,
    progress: Progress | None = None,
) -> HeightField:
    """The heights of a map.

    Args:
        work: folder of a file that ends with the call, 65 kB a view.
        cell: side of a cell in the ground's unit; None: found from the map's resolution.

    Raises:
        InputError: the views show nothing, the cells would be too many, or ``work`` cannot be
            written to.
    """
    mapper = shown.mapper
    ranges = ViewRanges(mapper, ground, work, progress and partial(progress, "views"))
    splats = GroundSplats(shown, ground)
    resolution = max(_spacing(splats.places, ranges), MATCH_PX * ranges.footprint)
    reach = ranges.median_range * float(
        np.median([view.camera.width / view.camera.fx for view in mapper.views])
    )
    # What is filmed around the map's edge, and not mapped, is surveyed, too.
    low, high = ranges.low - 0.5 * reach, ranges.high + 0.5 * reach
    side = _cell(cell, resolution, *(high - low))
    grid = Grid.around(low, high, side, np.zeros(2))
    height, blurred = _draw(splats, grid, ranges.footprint, resolution, progress)
    sigma, views = _over(grid, height, partial(_see, ranges))
    height[views < LEAST_VIEWS] = np.nan
    if not np.isfinite(height).any():
        raise InputError("no two views of the dive see the same ground; map a denser survey")
    blurred[np.isnan(height)] = np.nan
    return HeightField(
        grid, height, blurred, sigma, _held_heights(ranges, grid, height), resolution, reach
    )


def _cell(asked: float | None, resolution: float, width: float, height: float) -> float:
    """As asked for; else as found, larger where the dive would have too many.

    Raises:
        InputError: what was asked for makes too many.
    """
    if asked is not None:
        if width * height / asked**2 > MOST_CELLS:
            raise InputError(
                f"cells of {asked:g} on {width:.3g} x {height:.3g} are more than {MOST_CELLS}; "
                "give a larger --cell"
            )
        return asked
    return found_cell(max(resolution, math.sqrt(width * height / MOST_CELLS)))


def found_cell(resolution: float) -> float:
    """The least of 1, 2, 5, 10, ... that is CELL_RESOLUTIONS resolutions long."""
    least = CELL_RESOLUTIONS * resolution
    ten = 10.0 ** math.floor(math.log10(least))
    return next(step * ten for step in (*STEPS, 10.0) if step * ten >= least)


def _spacing(
    places: Array,  # [N, 2] x, y of Gaussians on the ground
    ranges: ViewRanges,
) -> float:
    """Between neighbouring Gaussians, were they even: the root of the area that each has."""
    inside = ((places >= ranges.low) & (places <= ranges.high)).all(axis=1)
    side = BIN_FOOTPRINTS * ranges.footprint
    bins = np.unique(np.floor(places[inside] / side).astype(np.int64), axis=0)
    return float(side * np.sqrt(len(bins) / max(1, int(inside.sum()))))


def _draw(
    splats: GroundSplats, grid: Grid, footprint: float, resolution: float, progress: Progress | None
) -> tuple[Array, Array]:
    """[h, w] heights and blurred heights; NaN where the map does not cover half a cell."""
    fine = Grid(grid.left, grid.top, grid.pixel / PARTS, PARTS * grid.width, PARTS * grid.height)
    finer = min(MOST_FINER, max(1, round(fine.pixel / footprint)))
    height = np.full((grid.height, grid.width), np.nan)
    blurred = height.copy()
    for done, tile in enumerate(fine.tiles(), 1):
        chosen = splats.reaching(fine, tile)
        if len(chosen):
            drawn = splats.draw(fine, tile, chosen, finer)
            solid = drawn.alpha > SOLID
            softer = _blur(drawn.height, solid, resolution / fine.pixel)
            rows = slice(tile.row // PARTS, (tile.row + tile.height) // PARTS)
            columns = slice(tile.column // PARTS, (tile.column + tile.width) // PARTS)
            height[rows, columns] = _means(drawn.height, solid)
            blurred[rows, columns] = _means(softer, solid)
        if progress is not None:
            progress("tiles", done, fine.tile_count)
    return height, blurred


def _blur(
    height: Array,  # [h, w]
    solid: npt.NDArray[np.bool_],  # [h, w]
    sigma_px: float,
) -> Array:
    """[h, w] means weighted by a Gaussian, of what is solid alone."""
    weights = gaussian_filter(solid.astype(np.float64), sigma_px)
    summed = gaussian_filter(np.where(solid, height, 0.0), sigma_px)
    return np.asarray(np.where(solid, summed / np.maximum(weights, np.finfo(float).tiny), np.nan))


def _means(
    height: Array,  # [PARTS h, PARTS w]
    solid: npt.NDArray[np.bool_],  # [PARTS h, PARTS w]
) -> Array:
    """[h, w] of the solid parts of each cell; NaN where they are too few."""
    shape = (height.shape[0] // PARTS, PARTS, height.shape[1] // PARTS, PARTS)
    count = solid.reshape(shape).sum(axis=(1, 3))
    total = np.where(solid, height, 0.0).reshape(shape).sum(axis=(1, 3))
    enough = count >= LEAST_FILLED * PARTS**2
    return np.asarray(np.where(enough, total / np.maximum(count, 1), np.nan))


def _over(
    grid: Grid,
    height: Array,  # [h, w]
    look: Callable[[Array], tuple[Array, Counts]],
) -> tuple[Array, Counts]:
    """[h, w] two numbers of each cell that has a height, tile by tile; NaN and 0 elsewhere."""
    values, counts = np.full(height.shape, np.nan), np.zeros(height.shape, np.int32)
    for tile in grid.tiles():
        part = tile.part
        known = np.isfinite(height[part])
        if known.any():
            points = np.dstack([grid.centres(tile), height[part]])[known]
            values[part][known], counts[part][known] = look(points)
    return values, counts


def _see(
    ranges: ViewRanges,
    points: Array,  # [M, 3] on the ground
) -> tuple[Array, Counts]:
    seen = ranges.see(points)
    return seen.sigma, seen.count


def _held_heights(
    ranges: ViewRanges,
    grid: Grid,
    height: Array,  # [h, w]
) -> Held:
    """What pictures show, with the heights of the nearest mapped cells where there are none."""
    mapped = np.isfinite(height)
    nearest = distance_transform_edt(~mapped, return_distances=False, return_indices=True)
    filled = height[tuple(nearest)]
    raised = np.where(mapped, filled, filled + np.std(height[mapped]))

    def counts(
        heights: Array,  # [h, w]
        margin_px: float = 0.0,
    ) -> Counts:
        def hold(
            points: Array,  # [M, 3]
        ) -> tuple[Array, Counts]:
            return np.zeros(len(points)), ranges.hold(points, margin_px)

        return _over(grid, heights, hold)[1]

    return Held(
        counts(filled), counts(filled, PICTURE_SIGMA_PX), counts(filled, -PICTURE_SIGMA_PX),
        counts(raised),
    )  # fmt: skip
