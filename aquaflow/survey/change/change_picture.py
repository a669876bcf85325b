"""``change.png``: both days, distances, and the patches with their numbers, to look at."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.survey.change.comparison import (
    BLEACHED,
    GAINED,
    LOST,
    MOVED_AWAY,
    MOVED_HERE,
    NOT_SEEN,
    UNCHANGED,
    SurfaceComparison,
)
from aquaflow.survey.change.patches import NAMES, Patch
from aquaflow.survey.change.surface import Surface
from aquaflow.survey.export.ortho.geotiff import writing_raster
from aquaflow.survey.export.ortho.grid import NODATA, Grid, RasterFile
from aquaflow.survey.export.ortho.ground import Ground

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

WIDTH_IN, DOTS_PER_INCH = 16.0, 110
COLOURS = {
    NOT_SEEN: "#d9d9d9", UNCHANGED: "#8c9aa5", GAINED: "#1b9e77", LOST: "#d95f02",
    BLEACHED: "#ffd92f", MOVED_AWAY: "#e7298a", MOVED_HERE: "#7570b3",
}  # fmt: skip
"""Of the classes: ColorBrewer's Dark2, which most colour-blind people tell apart."""
WORDS = {NOT_SEEN: "seen on one day alone", UNCHANGED: "unchanged", **NAMES}
"""Of the classes, in the legend."""
SHOWN_PERCENTILE = 99.0
"""Of brightness, which is white in the pictures of the days."""
SHOWN_LEVELS = 3.0
"""Ends of the scale of distances, in median levels of detection."""


def change_png(
    compared: SurfaceComparison, patches: list[Patch], first: Surface, second: Surface, unit: str
) -> bytes:
    """A PNG file."""
    figure = change_figure(compared, patches, first, second, unit)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Software": "AquaFlow"})
    return buffer.getvalue()


def change_figure(
    compared: SurfaceComparison, patches: list[Patch], first: Surface, second: Surface, unit: str
) -> Figure:
    """Both days, distances and classes side by side, from above, with what the colours mean."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    grid = grid_of(compared)
    bands = np.where(bands_of(compared, grid) == NODATA, np.nan, bands_of(compared, grid))
    extent = (
        grid.left, grid.left + grid.width * grid.pixel,
        grid.top - grid.height * grid.pixel, grid.top,
    )  # fmt: skip
    height = 0.25 * WIDTH_IN * grid.height / grid.width + 1.0
    figure = Figure(figsize=(WIDTH_IN, float(np.clip(height, 3.0, 12.0))), layout="constrained")
    axes = figure.subplots(1, 4)
    titles = ("first day", "second day, in the first's light", f"distance, {unit}", "changes")
    white = float(np.percentile(first.colours.max(axis=1), SHOWN_PERCENTILE))
    gains = np.array(compared.colours.gains)
    axes[0].imshow(seen_from_above(first, np.ones(3), grid, white), extent=extent)
    axes[1].imshow(seen_from_above(second, gains, grid, white), extent=extent)
    most = SHOWN_LEVELS * float(np.nanmedian(compared.distances.level()))
    shown = axes[2].imshow(bands[0], extent=extent, cmap="coolwarm", vmin=-most, vmax=most)
    figure.colorbar(shown, ax=axes[2], shrink=0.6)
    kinds = sorted(COLOURS)
    colours = ListedColormap([COLOURS[kind] for kind in kinds])
    norm = BoundaryNorm([kind - 0.5 for kind in [*kinds, kinds[-1] + 1]], len(kinds))
    axes[3].imshow(bands[2], extent=extent, cmap=colours, norm=norm, interpolation="nearest")
    for each, title in zip(axes, titles, strict=True):
        each.set_title(title)
        each.set_aspect("equal")
    _label(axes[3], patches)
    there = [Patch(color=COLOURS[kind], label=WORDS[kind]) for kind in kinds if kind in bands[2]]
    figure.legend(handles=there, loc="outside lower right", ncols=len(there), frameon=False)
    return figure


def _label(axes: Any, patches: list[Patch]) -> None:
    for number, patch in enumerate(patches, 1):
        axes.annotate(
            f"{number} {NAMES[patch.kind]}", tuple(patch.place[:2]), xytext=(8, 8),
            textcoords="offset points", fontsize=9,
            arrowprops={"arrowstyle": "-", "linewidth": 0.5},
        )  # fmt: skip


def seen_from_above(
    surface: Surface,
    gains: Array,  # [3] that are taken off
    grid: Grid,
    white: float,
) -> npt.NDArray[np.float32]:
    """[h, w, 4] RGBA of the highest points of a surface."""
    column = np.floor((surface.points[:, 0] - grid.left) / grid.pixel).astype(np.intp)
    row = np.floor((grid.top - surface.points[:, 1]) / grid.pixel).astype(np.intp)
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    which = np.flatnonzero(inside)
    which = which[np.argsort(surface.points[which, 2], kind="stable")]
    picture = np.zeros((grid.height, grid.width, 4), np.float32)
    colours = np.clip(surface.colours[which] / (gains * white), 0.0, 1.0) ** (1.0 / 2.2)
    picture[row[which], column[which]] = np.column_stack([colours, np.ones(len(which))])
    return picture


# --------------------------------------------------------------------------------------------------
# ``change.tif``: the changes from above, on the first dive's ground axes or UTM grid.

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
            raster.write(tile, bands[(slice(None), *tile.part)])
