"""``aquaflow export --format ortho`` and ``dem``: the rasters of a dive, tile by tile."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.storage.whole_folder import whole_files, whole_folder
from aquaflow.dive.dive import Dive
from aquaflow.dive.shown_views import ShownViews
from aquaflow.mapping.mapper import Mapper
from aquaflow.survey.export.ortho.drawing import MOST_FINER, Colours, GroundSplats
from aquaflow.survey.export.ortho.geotiff import require_rasterio, writing_raster
from aquaflow.survey.export.ortho.grid import (
    DEM,
    ORTHO,
    QUALITY,
    Grid,
    GridTile,
    MapLayer,
    TilePixels,
    round_to_digits,
)
from aquaflow.survey.export.ortho.ground import LEAST_VIEWS, Ground, ground_of
from aquaflow.survey.export.ortho.relief import write_relief
from aquaflow.survey.export.ortho.sightings import PICTURE_SIGMA_PX, ViewRanges
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.sightings import SOLID

Kind = Literal["ortho", "dem"]
Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""

LAYERS: dict[Kind, tuple[MapLayer, ...]] = {"ortho": (ORTHO, QUALITY), "dem": (DEM,)}
"""Files of each kind."""
ENDING = ".tif"
HEIGHT_SIGMA_PX = 0.5
"""1 sigma of where a view shows a point, for heights. What is missing to one pixel
(sightings.PICTURE_SIGMA_PX) moves whole views, and hardly the heights between them."""
SPREAD_SHARE = 0.75
"""1 sigma of a height over the spread of the heights within the pixel. Both were chosen on surveys
of sand and two reefs, so that the stated intervals hold the truth as often as they say
(notes/2026-11-survey.md#orthos)."""
SIGMA_IS = (
    f"of where the rays of the views that see the pixel meet, each known to {HEIGHT_SIGMA_PX:g} "
    f"pixel of its picture, and {SPREAD_SHARE:g} of the spread of the map's heights within the "
    "pixel; poses are taken as exact"
)
"""What 1 sigma of the height covers, in words."""


@dataclass(frozen=True)
class SurveyFiles:
    """What was written."""

    files: dict[Kind, list[Path]]
    width: int
    height: int
    """Pixels."""
    resolution: float
    """Side of a pixel in the raster's coordinates."""
    covered: float
    """Share of the pixels that are no holes."""
    ground: Ground
    water_range: float | None
    """Of the water that the ortho is seen through, in the ground's unit."""


def export_survey(
    dive: Dive,
    targets: Mapping[Kind, Path],
    resolution: float | None = None,
    water: bool = False,
    progress: Progress | None = None,
) -> SurveyFiles:
    """Write the ortho, the elevations or both of the dive's largest sub-map.

    Args:
        targets: of each kind: a folder, or its file if that ends in .tif; other files of the kind
            are beside it: NAME_quality.tif, or NAME_hillshade.tif and NAME_contours.geojson.
        resolution: side of a pixel, m, or map units where the dive has no metres; None: what a
            pixel of the mapped pictures shows, median.
        water: of an ortho: with the water, as seen from the views' median range.

    Raises:
        InputError: rasterio is missing, the dive has no map, views or ground (``ground_of``), the
            raster would be too large, or a file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    require_rasterio()
    mapper, frame = dive.filled_map(), dive.frame
    shown = ShownViews(mapper)
    ground = ground_of(frame, mapper)
    work = next(iter(targets.values())).parent
    ranges = ViewRanges(mapper, ground, work, progress and partial(progress, "views"))
    side = resolution or round_to_digits(ranges.footprint)
    start = -np.array(ground.origin) / ground.grid_scale
    grid = Grid.around(ranges.low, ranges.high, side / ground.grid_scale, start)
    through = ranges.median_range if water and mapper.medium.active else None
    colours = Colours(mapper, ground.T_gm.scale, through) if "ortho" in targets else None
    looked = _Tiles(grid, GroundSplats(shown, ground), ranges, colours)
    layers = {kind: _named(kind, path) for kind, path in targets.items()}
    covered = 0
    with ExitStack() as folders:
        made = {kind: folders.enter_context(_whole(path)) for kind, path in targets.items()}
        tags = {
            kind: _tags(dive, frame, ground, side, through, kind == "ortho") for kind in targets
        }
        with ExitStack() as files:
            rasters = [
                (layer, files.enter_context(
                    writing_raster(made[kind], layer, grid, ground, tags[kind])
                ))
                for kind in targets
                for layer in layers[kind]
            ]  # fmt: skip
            for done, tile in enumerate(grid.tiles()):
                pixels = looked.at(tile)
                if pixels is not None:
                    covered += int(pixels.mapped.sum())
                    for layer, raster in rasters:
                        raster.write(tile, layer.values(pixels))
                if progress is not None:
                    progress("tiles", done + 1, grid.tile_count)
        names = {kind: [layer.name for layer in layers[kind]] for kind in targets}
        if "dem" in targets:
            dem = made["dem"] / names["dem"][0]
            names["dem"] += write_relief(dem, grid, ground, tags["dem"])
    share = covered / (grid.width * grid.height)
    paths = {
        kind: [(path.parent if _is_file(path) else path) / name for name in names[kind]]
        for kind, path in targets.items()
    }
    return SurveyFiles(paths, grid.width, grid.height, side, share, ground, through)


def _is_file(target: Path) -> bool:
    return target.suffix.lower() == ENDING


def _whole(target: Path) -> AbstractContextManager[Path]:
    return whole_files(target) if _is_file(target) else whole_folder(target)


def _named(kind: Kind, target: Path) -> list[MapLayer]:
    """The layers of a kind; named as ``target`` is, if it is a file."""
    if not _is_file(target):
        return list(LAYERS[kind])
    first, *others = LAYERS[kind]
    named = [replace(each, name=each.name.replace(kind, target.stem, 1)) for each in others]
    return [replace(first, name=target.name), *named]


@dataclass(frozen=True)
class _Tiles:
    """Everything that tiles are made of."""

    grid: Grid
    splats: GroundSplats
    ranges: ViewRanges
    colours: Colours | None

    def at(self, tile: GridTile) -> TilePixels | None:
        """The pixels of a tile; None where nothing is mapped."""
        chosen = self.splats.reaching(self.grid, tile)
        if len(chosen) == 0:
            return None
        finer = min(MOST_FINER, max(1, round(self.grid.pixel / self.ranges.footprint)))
        drawn = self.splats.draw(self.grid, tile, chosen, finer)
        solid = drawn.alpha > SOLID
        if not solid.any():
            return None
        points = np.dstack([self.grid.centres(tile), drawn.height])[solid]
        seen = self.ranges.see(points)
        views, sigma = np.zeros(solid.shape, np.int32), np.full(solid.shape, np.nan)
        nearest = np.full(solid.shape, np.inf)
        views[solid], sigma[solid], nearest[solid] = seen.count, seen.sigma, seen.nearest
        sigma = np.hypot(HEIGHT_SIGMA_PX / PICTURE_SIGMA_PX * sigma, SPREAD_SHARE * drawn.spread)
        picture = None if self.colours is None else self.colours.of(drawn.radiance, nearest)
        return TilePixels(solid & (views >= LEAST_VIEWS), drawn.height, sigma, views, picture)


def _tags(
    dive: Dive, frame: WorldFrame, ground: Ground, side: float, through: float | None, ortho: bool
) -> dict[str, str]:
    """What the files say of themselves, in words."""
    tags = {
        "SOFTWARE": f"AquaFlow {__version__}",
        "DIVE": dive.name,
        "UNIT": ground.unit,
        "AXES": ground.axes,
        "VERTICAL": ground.vertical,
        "HEIGHT_ZERO": ground.height_zero,
        "PIXEL": f"{side:g} {ground.unit}",
        "SIGMA": SIGMA_IS,
        "HOLES": f"not mapped, or seen by fewer than {LEAST_VIEWS} views",
    }
    if frame.metric:
        tags["SCALE_SIGMA"] = f"{frame.scale_sigma:.3g} (relative, 1 sigma)"
    if ground.epsg is not None and frame.origin is not None:
        tags["POSITION_SIGMA"] = f"{frame.origin.sigma_m:.3g} m (1 sigma, of the whole raster)"
    if ortho:
        tags["COLOURS"] = (
            "without water" if through is None else f"through {through:.3g} {ground.unit} of water"
        )
    return tags


# --------------------------------------------------------------------------------------------------
# The map from straight above as one small picture, drawn in a second, without its water.

Array = npt.NDArray[np.float64]

LONGER_SIDE_PX = 720
"""Of the picture, about."""
SHOWN = (2.0, 98.0)
"""Percent of what these views show, along each axis, within which the picture lies: beyond are
single Gaussians in the water."""
SOLID_ALPHA = 0.5
"""Cover of a pixel above which the map is there."""


def overview_png(mapper: Mapper, frame: WorldFrame) -> bytes:
    """A PNG file, transparent where the map is not; its top is what is up on the ground's axes.

    Raises:
        InputError: the map has no ground (``ground_of``).
    """
    from PIL import Image

    shown = ShownViews(mapper)
    ground = ground_of(frame, mapper)
    low, high, distance = _extent(shown, ground)
    pixel = round_to_digits(float((high - low).max()) / LONGER_SIDE_PX)
    grid = Grid.around(low, high, pixel, low)
    splats, colours = GroundSplats(shown, ground), Colours(mapper, ground.T_gm.scale, None)
    picture = np.zeros((grid.height, grid.width, 4), np.uint8)
    for tile in grid.tiles():
        chosen = splats.reaching(grid, tile)
        if len(chosen):
            picture[tile.part] = _tile(splats, colours, grid, tile, chosen, distance)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def _tile(
    splats: GroundSplats,
    colours: Colours,
    grid: Grid,
    tile: GridTile,
    chosen: npt.NDArray[np.intp],  # [M] of the Gaussians
    distance: float,
) -> npt.NDArray[np.uint8]:
    """[h, w, 4] RGBA."""
    drawn = splats.draw(grid, tile, chosen)
    nearest = np.full(drawn.alpha.shape, distance)
    rgb, _ = colours.of(drawn.radiance, nearest)
    alpha = np.where(drawn.alpha > SOLID_ALPHA, 255, 0).astype(np.uint8)
    return np.dstack([rgb, alpha])


def _extent(shown: ShownViews, ground: Ground) -> tuple[Array, Array, float]:
    """Lowest and highest x, y [2] of what the views show, and their median range."""
    points = shown.points()
    if not points:
        every = np.array([ground.pose(view.T_wc).t[:2] for view in shown.mapper.views])
        return every.min(axis=0) - 1.0, every.max(axis=0) + 1.0, 1.0
    places = ground.T_gm.apply(np.concatenate([each.places for each in points]))
    low, high = np.percentile(places[:, :2], SHOWN, axis=0)
    return (
        low,
        high,
        ground.T_gm.scale * float(np.median(np.concatenate([each.ranges for each in points]))),
    )
