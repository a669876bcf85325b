"""A hillshade and contours of written elevations, for maps that people read."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import load
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.export.ortho.geotiff import require_rasterio, writing_raster
from aquaflow.survey.export.ortho.grid import Grid, RasterFile
from aquaflow.survey.export.ortho.ground import Ground

Array = npt.NDArray[np.float64]

HILLSHADE = RasterFile(
    "dem_hillshade.tif", ("grey", "grey", "grey", "alpha: 255 mapped, 0 hole"), False
)
CONTOURS = "dem_contours.geojson"
LIGHT_FROM_DEG, LIGHT_HEIGHT_DEG = 315.0, 45.0
"""Direction, clockwise from what is up in the raster, and height of the light: those that maps have
by custom; from below, hills look like pits."""
CONTOURED_PX = 2048
"""Longer side at most of the elevations that contours are drawn from; finer ones are averaged."""
INTERVALS = 10.0
"""Contours from the lowest ground to the highest, about."""
RANGE_PERCENT = (2.0, 98.0)
"""Of the heights, for what is lowest and highest."""
INTERVAL_SIGMAS = 2.0
"""Median sigmas of the heights that neighbouring contours are apart at least."""
DECIMALS = 5
"""Of contours' coordinates: 0.01 mm."""
SHORTEST_PX = 10.0
"""Contours that are shorter are left out: noise of single pixels."""


def write_relief(dem: Path, grid: Grid, ground: Ground, tags: Mapping[str, str]) -> list[str]:
    """Write HILLSHADE and CONTOURS of the file ``dem`` beside it, named after it; their names.

    Raises:
        InputError: a file cannot be written.
    """
    shaded = replace(HILLSHADE, name=HILLSHADE.name.replace("dem", dem.stem, 1))
    lines = CONTOURS.replace("dem", dem.stem, 1)
    _write_hillshade(dem, shaded, grid, ground, tags)
    _write_contours(dem, dem.parent / lines, ground)
    return [shaded.name, lines]


def _write_hillshade(
    dem: Path, layer: RasterFile, grid: Grid, ground: Ground, tags: Mapping[str, str]
) -> None:
    """Tile by tile, each with a rim of its neighbours."""
    rasterio = require_rasterio()
    from rasterio.windows import Window

    with (
        rasterio.open(dem) as heights,
        writing_raster(dem.parent, layer, grid, ground, tags) as raster,
    ):
        for tile in grid.tiles():
            window = Window(tile.column - 1, tile.row - 1, tile.width + 2, tile.height + 2)
            around = heights.read(
                1, window=window, boundless=True, masked=True, fill_value=heights.nodata
            )
            z = np.ma.filled(around.astype(np.float64), np.nan)
            if np.isfinite(z).any():
                grey = shade(z, grid.pixel)
                alpha = np.where(np.isfinite(z[1:-1, 1:-1]), np.uint8(255), np.uint8(0))
                raster.write(tile, np.stack([grey * (alpha > 0)] * 3 + [alpha]))


def shade(
    heights: Array,  # [h + 2, w + 2] with a rim of one pixel; NaN in holes
    pixel: float,
) -> npt.NDArray[np.uint8]:
    """[h, w] brightness of a matt ground, by the slopes of Horn (1981), "Hill shading and the
    reflectance map". A neighbour in a hole is taken to be as high as the pixel."""
    rows, columns = heights.shape
    middle = heights[1:-1, 1:-1]

    def beside(down: int, right: int) -> Array:
        part = heights[1 + down : rows - 1 + down, 1 + right : columns - 1 + right]
        return np.where(np.isfinite(part), part, middle)

    weights = ((-1, 1.0), (0, 2.0), (1, 1.0))
    east = sum(w * (beside(k, 1) - beside(k, -1)) for k, w in weights) / (8.0 * pixel)
    north = sum(w * (beside(-1, k) - beside(1, k)) for k, w in weights) / (8.0 * pixel)
    azimuth, height = np.radians([LIGHT_FROM_DEG, LIGHT_HEIGHT_DEG])
    light = np.cos(height) * np.array([np.sin(azimuth), np.cos(azimuth)])
    lit = np.sin(height) - east * light[0] - north * light[1]
    lit = np.nan_to_num(lit / np.sqrt(1.0 + east**2 + north**2))
    grey: npt.NDArray[np.uint8] = np.rint(255.0 * np.clip(lit, 0.0, 1.0)).astype(np.uint8)
    return grey


def _write_contours(dem: Path, path: Path, ground: Ground) -> None:
    """GeoJSON with a feature for each height, in raster coordinates.

    ``crs`` is that of GeoJSON before RFC 7946, which knows no map's grid; GDAL and QGIS read it.
    """
    rasterio = require_rasterio()
    with rasterio.open(dem) as heights:
        finer = max(1.0, max(heights.shape) / CONTOURED_PX)
        shape = tuple(max(1, round(side / finer)) for side in heights.shape)
        bands = heights.read(
            (1, 2), out_shape=(2, *shape), masked=True,
            resampling=rasterio.enums.Resampling.average,
        )  # fmt: skip
        to = heights.transform
        corner = np.array([to.c, to.f])
        pixel = np.array([to.a * heights.width / shape[1], to.e * heights.height / shape[0]])
    step = interval(bands[0].compressed(), bands[1].compressed())
    features = [
        {
            "type": "Feature",
            "properties": {"height": height, "unit": ground.unit, "zero": ground.height_zero},
            "geometry": {"type": "MultiLineString", "coordinates": lines},
        }
        for height, lines in _contours(bands[0], step, corner, pixel)
    ]
    crs = None
    if ground.epsg is not None:
        name = f"urn:ogc:def:crs:EPSG::{ground.epsg}"
        crs = {"type": "name", "properties": {"name": name}}
    collection = {"type": "FeatureCollection", "crs": crs, "features": features}
    with atomic_write(path) as stream:
        stream.write(json.dumps(collection).encode("utf-8"))


def interval(
    heights: Array,  # [N]
    sigmas: Array,  # [M] 1 sigma of each that has one
) -> float:
    """Between neighbouring contours: 1, 2 or 5 times a power of ten; 0 where there is no relief."""
    if len(heights) == 0:
        return 0.0
    low, high = np.percentile(heights, RANGE_PERCENT)
    least = INTERVAL_SIGMAS * float(np.median(sigmas)) if len(sigmas) else 0.0
    wanted = max(float(high - low) / INTERVALS, least)
    if wanted <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(min(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= 0.999 * wanted))


def _contours(
    heights: Any,  # [h, w] masked in holes
    step: float,
    corner: Array,  # [2] of the first pixel, in raster coordinates
    pixel: Array,  # [2] from a column, and a row, to the next one
) -> Iterator[tuple[float, list[list[list[float]]]]]:
    """Each height, and its lines in raster coordinates."""
    contourpy = load("contourpy", "contours", "survey")
    if step == 0.0 or min(heights.shape) < 2:
        return
    generator = contourpy.contour_generator(z=heights, line_type=contourpy.LineType.Separate)
    first, last = np.ceil(heights.min() / step), np.floor(heights.max() / step)
    for number in range(int(first), int(last) + 1):
        long = [
            line
            for line in generator.lines(number * step)
            if np.hypot(*np.diff(line, axis=0).T).sum() >= SHORTEST_PX
        ]
        if long:
            lines = [np.round(corner + pixel * (line + 0.5), DECIMALS).tolist() for line in long]
            yield round(number * step, 9), lines
