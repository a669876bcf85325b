"""The pixels of a raster, cut into tiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError

Array = npt.NDArray[np.float64]

TILE_PX = 512
"""Side of a tile: what a Cloud-Optimised GeoTIFF has by default; 2 MB for two float32 bands."""
MOST_SIDE_PX = 1 << 17
"""Pixels along a side: at 4 mm half a kilometre. More is a slip of the resolution."""
DIGITS = 2
"""Significant digits of a resolution that was found and not asked for."""


@dataclass(frozen=True)
class GridTile:
    """A rectangle of pixels."""

    row: int
    column: int
    """Of its first pixel, in the raster."""
    height: int
    width: int
    """Pixels."""

    @property
    def part(self) -> tuple[slice, slice]:
        """Its rows and columns in the raster."""
        return (
            slice(self.row, self.row + self.height),
            slice(self.column, self.column + self.width),
        )


@dataclass(frozen=True)
class Grid:
    """The raster's pixels on the ground."""

    left: float
    top: float
    """x and y of the outer corner of the first pixel, in the ground's unit."""
    pixel: float
    """Side of a pixel, in the ground's unit."""
    width: int
    height: int
    """Pixels."""

    @staticmethod
    def around(
        low: Array,  # [2] x, y on the ground
        high: Array,  # [2] x, y on the ground
        pixel: float,
        start: Array,  # [2] x, y on the ground, of the corner of some pixel
    ) -> Grid:
        """The smallest grid that holds what lies between.

        Raises:
            InputError: it would have too many pixels.
        """
        first, last = np.floor((low - start) / pixel), np.ceil((high - start) / pixel)
        sides = np.maximum(last - first, 1.0)
        if float(sides.max()) > MOST_SIDE_PX:
            raise InputError(
                f"a raster of {pixel:g} a pixel would have {sides[0]:.0f} x {sides[1]:.0f} pixels, "
                f"and {MOST_SIDE_PX} a side are the most; give a coarser --resolution"
            )
        left, top = start[0] + first[0] * pixel, start[1] + last[1] * pixel
        return Grid(float(left), float(top), pixel, int(sides[0]), int(sides[1]))

    def tiles(self) -> Iterator[GridTile]:
        """The tiles from the top left, row by row."""
        for row in range(0, self.height, TILE_PX):
            for column in range(0, self.width, TILE_PX):
                yield GridTile(
                    row, column,
                    min(TILE_PX, self.height - row), min(TILE_PX, self.width - column),
                )  # fmt: skip

    @property
    def tile_count(self) -> int:
        """How many :meth:`tiles` gives."""
        return math.ceil(self.height / TILE_PX) * math.ceil(self.width / TILE_PX)

    def bounds(self, tile: GridTile) -> tuple[Array, Array]:
        """Lowest and highest x, y [2] of a tile on the ground."""
        left, top = self.left + tile.column * self.pixel, self.top - tile.row * self.pixel
        size = self.pixel * np.array([tile.width, tile.height])
        low = np.array([left, top - size[1]])
        return low, low + size

    def centres(self, tile: GridTile) -> Array:
        """[h, w, 2] x and y of the pixels' centres on the ground."""
        x = self.left + (tile.column + np.arange(tile.width) + 0.5) * self.pixel
        y = self.top - (tile.row + np.arange(tile.height) + 0.5) * self.pixel
        return np.stack(np.meshgrid(x, y), axis=-1)


def round_to_digits(length: float) -> float:
    """``length`` with few digits."""
    return float(f"{length:.{DIGITS}g}")


# --------------------------------------------------------------------------------------------------
# What the files of an ortho and of elevations hold, band by band.

NODATA = -9999.0
"""In rasters of numbers, where nothing is known: survey software that reads no NaN takes it."""


@dataclass(frozen=True)
class TilePixels:
    """What is known of each pixel of a tile."""

    mapped: npt.NDArray[np.bool_]
    """[h, w], False in holes: the map is not solid there, or too few views see it."""
    height: Array
    """[h, w] in the ground's unit."""
    sigma: Array
    """[h, w] 1 sigma of it; NaN where unknown."""
    views: npt.NDArray[np.int32]
    """[h, w] how many see it."""
    picture: tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]] | None
    """Of an ortho: colours [h, w, 3], and what share of them was restored from light [h, w]."""


@dataclass(frozen=True)
class RasterFile:
    """One file."""

    name: str
    bands: tuple[str, ...]
    """In words; ``{unit}`` is the ground's."""
    numbers: bool
    """True: float32 with NODATA; False: 8-bit red, green, blue and alpha."""


@dataclass(frozen=True)
class MapLayer(RasterFile):
    """A file of what is known of tiles."""

    values: Callable[[TilePixels], npt.NDArray[Any]]
    """[bands, h, w] of a tile."""


def _colours(pixels: TilePixels) -> npt.NDArray[np.uint8]:
    assert pixels.picture is not None
    opaque = pixels.mapped[..., None]
    rgba = np.dstack([pixels.picture[0] * opaque, np.where(opaque, np.uint8(255), np.uint8(0))])
    return np.moveaxis(rgba, -1, 0)


def _quality(pixels: TilePixels) -> npt.NDArray[np.float32]:
    assert pixels.picture is not None
    return _numbers(pixels, pixels.views, pixels.sigma, pixels.picture[1])


def _heights(pixels: TilePixels) -> npt.NDArray[np.float32]:
    return _numbers(pixels, pixels.height, pixels.sigma, pixels.views)


def _numbers(
    pixels: TilePixels,
    *bands: npt.NDArray[Any],  # [h, w] each
) -> npt.NDArray[np.float32]:
    """[bands, h, w] with NODATA in holes and where a band knows nothing."""
    values = np.stack(bands).astype(np.float32)
    return np.where(pixels.mapped & np.isfinite(values), values, np.float32(NODATA))


SIGMA = "1 sigma of the height, {unit}"
VIEWS = "views that see the pixel"
ORTHO = MapLayer(
    "ortho.tif", ("red", "green", "blue", "alpha: 255 mapped, 0 hole"), False, _colours
)
QUALITY = MapLayer(
    "ortho_quality.tif", (VIEWS, SIGMA, "share of the colour restored from light"), True, _quality
)
DEM = MapLayer("dem.tif", ("height, {unit}", SIGMA, VIEWS), True, _heights)
