"""``change.tif``: the changes from above, on the first dive's ground axes or UTM grid."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.survey.change.comparison import NOT_SEEN, SurfaceComparison
from aquaflow.survey.export.ortho.geotiff import writing_raster
from aquaflow.survey.export.ortho.grid import Grid, GridTile
from aquaflow.survey.export.ortho.ground import Ground
from aquaflow.survey.export.ortho.layers import NODATA, RasterFile

Array = npt.NDArray[np.float64]

CHANGE = RasterFile(
    "change.tif",
    (
        "distance along the normal, {unit}, positive: gained",
        "level of detection at 95 %, {unit}",
        "class: 0 unchanged, 1 gained, 2 lost, 3 bleached, 4 moved away, 5 moved here, -1 seen on "
        "one day alone",
        "colour difference: natural log of the brightness over the first day's",
        "difference of the saturation",
    ),
    True,
)


def grid_of(compared: SurfaceComparison) -> Grid:
    """Pixels that each hold a core point where there is surface."""
    places = compared.places[:, :2]
    low, high = places.min(axis=0), places.max(axis=0)
    return Grid.around(low, high, compared.scales.apart, np.zeros(2))


def bands_of(compared: SurfaceComparison, grid: Grid) -> npt.NDArray[np.float32]:
    """[bands, h, w] of the highest core point in each pixel; NODATA where nothing is known."""
    column = np.floor((compared.places[:, 0] - grid.left) / grid.pixel).astype(np.intp)
    row = np.floor((grid.top - compared.places[:, 1]) / grid.pixel).astype(np.intp)
    column, row = np.clip(column, 0, grid.width - 1), np.clip(row, 0, grid.height - 1)
    upwards = np.argsort(compared.places[:, 2], kind="stable")  # the last one stays
    at = row[upwards], column[upwards]
    known = compared.kinds != NOT_SEEN
    layers: list[tuple[Array, bool]] = [
        (compared.distances.distance, True),
        (compared.distances.level(), True),
        (compared.kinds.astype(np.float64), False),
        (compared.colours.lighter, True),
        (compared.colours.purer, True),
    ]
    bands = np.full((len(layers), grid.height, grid.width), NODATA, np.float32)
    for band, (values, hide) in zip(bands, layers, strict=True):
        shown = np.isfinite(values) & (known if hide else True)
        band[at] = np.where(shown, values, NODATA)[upwards]
    return bands


def write_change_raster(
    folder: Path, compared: SurfaceComparison, ground: Ground, tags: Mapping[str, str]
) -> None:
    """Write the file into ``folder``.

    Raises:
        InputError: rasterio is missing, or the file cannot be written.
    """
    grid = grid_of(compared)
    bands = bands_of(compared, grid)
    with writing_raster(folder, CHANGE, grid, ground, tags) as raster:
        for tile in grid.tiles():
            raster.write(tile, bands[(slice(None), *_part(tile))])


def _part(tile: GridTile) -> tuple[slice, slice]:
    return (
        slice(tile.row, tile.row + tile.height),
        slice(tile.column, tile.column + tile.width),
    )
