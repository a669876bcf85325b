"""What the files of an ortho and of elevations hold, band by band."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

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
