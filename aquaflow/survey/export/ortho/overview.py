"""The map from straight above as one small picture, drawn in a second, without its water."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.mapper import Mapper
from aquaflow.render.transfers import picture_out
from aquaflow.survey.export.ortho.colours import Colours
from aquaflow.survey.export.ortho.drawing import GroundSplats
from aquaflow.survey.export.ortho.grid import Grid, GridTile, round_to_digits
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

LONGER_SIDE_PX = 720
"""Of the picture, about."""
MOST_VIEWS = 30
"""Views whose ranges say how far the picture reaches."""
SHOWN = (2.0, 98.0)
"""Percent of what these views show, along each axis, within which the picture lies: beyond are
single Gaussians in the water."""
REACH = 3.0
"""Times the median range up to which what a view shows counts, as in the ortho."""
SOLID_ALPHA = 0.5
"""Cover of a pixel above which the map is there."""


def overview_png(mapper: Mapper, frame: WorldFrame) -> bytes:
    """A PNG file, transparent where the map is not; its top is what is up on the ground's axes.

    Raises:
        InputError: nothing says which way is up, and the views look in all directions.
    """
    from PIL import Image

    ground = ground_of(frame, mapper.views)
    low, high, distance = _extent(mapper, ground)
    pixel = round_to_digits(float((high - low).max()) / LONGER_SIDE_PX)
    grid = Grid.around(low, high, pixel, low)
    splats, colours = GroundSplats(mapper, ground), Colours(mapper, ground.T_gm.scale, None)
    picture = np.zeros((grid.height, grid.width, 4), np.uint8)
    for tile in grid.tiles():
        chosen = splats.reaching(grid, tile)
        if len(chosen):
            picture[_part(tile)] = _tile(splats, colours, grid, tile, chosen, distance)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def _part(tile: GridTile) -> tuple[slice, slice]:
    return (
        slice(tile.row, tile.row + tile.height),
        slice(tile.column, tile.column + tile.width),
    )


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


def _extent(mapper: Mapper, ground: Ground) -> tuple[Array, Array, float]:
    """Lowest and highest x, y [2] of what the views show, and their median range."""
    step = max(1, len(mapper.views) // MOST_VIEWS)
    places, ranges = [], []
    for view in mapper.views[::step]:
        z = picture_out(mapper.show(view).z)[::8, ::8].astype(np.float64) * ground.T_gm.scale
        rays = view.camera.unproject(view.camera.pixel_centres()[::8, ::8])
        unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        near = (z > 0.0) & (z < REACH * np.median(z[z > 0.0])) if (z > 0.0).any() else z > 0.0
        places.append(ground.pose(view.T_wc).apply((unit * z[..., None])[near])[:, :2])
        ranges.append(z[near])
    every = np.concatenate(places)
    if len(every) == 0:
        every = np.array([ground.pose(view.T_wc).t[:2] for view in mapper.views])
        return every.min(axis=0) - 1.0, every.max(axis=0) + 1.0, 1.0
    low, high = np.percentile(every, SHOWN, axis=0)
    return low, high, float(np.median(np.concatenate(ranges)))
