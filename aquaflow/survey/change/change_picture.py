"""``change.png``: both days, distances, and the patches with their numbers, to look at."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.survey.change.change_raster import bands_of, grid_of
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
from aquaflow.survey.export.ortho.grid import Grid
from aquaflow.survey.export.ortho.layers import NODATA

Array = npt.NDArray[np.float64]

WIDTH_IN, DOTS_PER_INCH = 16.0, 110
COLOURS = {
    NOT_SEEN: "#d9d9d9", UNCHANGED: "#8c9aa5", GAINED: "#1b9e77", LOST: "#d95f02",
    BLEACHED: "#ffd92f", MOVED_AWAY: "#e7298a", MOVED_HERE: "#7570b3",
}  # fmt: skip
"""Of the classes: ColorBrewer's Dark2, which most colour-blind people tell apart."""
SHOWN_PERCENTILE = 99.0
"""Of brightness, which is white in the pictures of the days."""
SHOWN_LEVELS = 3.0
"""Ends of the scale of distances, in median levels of detection."""


def change_png(
    compared: SurfaceComparison, patches: list[Patch], first: Surface, second: Surface, unit: str
) -> bytes:
    """A PNG file."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.figure import Figure

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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Software": "AquaFlow"})
    return buffer.getvalue()


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
