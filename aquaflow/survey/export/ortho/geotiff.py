"""Cloud-Optimised GeoTIFFs that are written tile by tile.

Tiles go into a plain tiled file beside the result; GDAL's COG driver then makes the result of it,
with overviews, and it takes its place whole or not at all.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from aquaflow.base.errors import InputError, first_line, load
from aquaflow.base.storage.atomic import fresh_file, scratch_file
from aquaflow.survey.export.ortho.grid import NODATA, TILE_PX, Grid, GridTile, RasterFile
from aquaflow.survey.export.ortho.ground import Ground

CACHE_MB = 64
"""GDAL's cache of blocks; it takes a twentieth of the memory otherwise."""
LOCAL_METRES = 'LOCAL_CS["{name}",UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
"""A coordinate system that says metres, and nothing of the place. GeoTIFF keeps no axes of one:
every reader calls them easting and northing."""


def require_rasterio() -> Any:
    """The module rasterio.

    Raises:
        InputError: it is not installed.
    """
    return load("rasterio", "a GeoTIFF", "survey")


class Raster:
    """A raster that is being written."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    def write(
        self,
        tile: GridTile,
        values: npt.NDArray[Any],  # [bands, h, w]
    ) -> None:
        """Put a tile into its place."""
        from rasterio.windows import Window

        window = Window(tile.column, tile.row, tile.width, tile.height)
        self._dataset.write(values, window=window)


@contextlib.contextmanager
def writing_raster(
    folder: Path, layer: RasterFile, grid: Grid, ground: Ground, tags: Mapping[str, str]
) -> Iterator[Raster]:
    """A raster that becomes the layer's file in ``folder`` when the block ends well.

    Tiles that are never written are holes.

    Raises:
        InputError: rasterio is missing, or the file cannot be written.
    """
    rasterio = require_rasterio()
    path = folder / layer.name
    try:
        with (
            rasterio.Env(GDAL_CACHEMAX=CACHE_MB, GDAL_PAM_ENABLED=False),
            scratch_file(path) as tiled,
            fresh_file(path) as part,
        ):
            with rasterio.open(tiled, "w", **_profile(layer, grid, ground)) as dataset:
                dataset.descriptions = tuple(band.format(unit=ground.unit) for band in layer.bands)
                dataset.update_tags(**tags)
                yield Raster(dataset)
            _optimise(tiled, part, layer)
    except (OSError, rasterio.errors.RasterioError) as error:
        raise InputError(
            f"cannot write {path}: {first_line(error)}; give a folder with room that can be "
            "written to"
        ) from error


def _profile(layer: RasterFile, grid: Grid, ground: Ground) -> dict[str, Any]:
    """Of the file that tiles are written into."""
    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": len(layer.bands),
        "crs": _crs(ground), "transform": _transform(grid, ground),
        "tiled": True, "blockxsize": TILE_PX, "blockysize": TILE_PX, "interleave": "pixel",
        "compress": "deflate", "zlevel": 1, "bigtiff": "if_safer",
    }  # fmt: skip
    if layer.numbers:
        return profile | {"dtype": "float32", "nodata": NODATA}
    return profile | {"dtype": "uint8", "photometric": "rgb", "alpha": "non-premultiplied"}


def _optimise(tiled: Path, part: Path, layer: RasterFile) -> None:
    """The file ``part`` with the tiles of ``tiled`` and overviews of them."""
    from rasterio import shutil

    shutil.copy(
        tiled, part, driver="COG", compress="deflate", predictor="yes", blocksize=TILE_PX,
        overview_resampling="nearest" if layer.numbers else "average", bigtiff="if_safer",
    )  # fmt: skip


def _crs(ground: Ground) -> Any:
    """None where lengths are map units, or x is not east."""
    from rasterio.crs import CRS

    if ground.epsg is not None:
        return CRS.from_epsg(ground.epsg)
    if ground.unit == "m" and ground.where.directions == ("east", "north"):
        return CRS.from_wkt(LOCAL_METRES.format(name=f"AquaFlow: {ground.axes}"))
    return None


def _transform(grid: Grid, ground: Ground) -> Any:
    """From columns and rows to raster coordinates."""
    from rasterio.transform import Affine

    k, (x, y) = ground.grid_scale, ground.origin
    pixel = k * grid.pixel
    return Affine(pixel, 0.0, x + k * grid.left, 0.0, -pixel, y + k * grid.top)
