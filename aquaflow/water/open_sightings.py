"""Open water in the pictures as observations: what backscatter looks like at infinity."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.water.model import Trial, gain_map
from aquaflow.water.observations import PICTURES_AT_ONCE, Observations
from aquaflow.water.sightings import PosedPicture

Array = npt.NDArray[np.float64]

COLUMNS, ROWS = 8, 6
"""Cells of a picture; one that is all open water gives an observation, its mean colour. Water is
smooth: finer cells say the same again."""
MOST_UNEVEN = 0.012
"""Relative deviation of a cell's brightness, in blocks, from a plane. Nine of ten open cells have
less on IUI3 and two of three on Curasao; where ground is dim and far, in murky rendered dives, one
of three to ten."""
BLOCKS = 4
"""Along each side of a cell."""
INFINITE = 1e3
"""Range of open water over the median range of the surface: no light of a surface is left."""


def with_open_water(
    seen: Observations,
    pictures: Sequence[PosedPicture],
    trial: Trial,  # the water as found without
    mean: Array,  # [3] of the scene without that water
) -> Generator[None, None, Observations]:
    """The observations, and those of what looks like open water by that trial, a point each; with
    pauses."""
    views, cells, colours = [], [], []
    for view in range(min(len(pictures), len(trial.exposure))):
        xy, colour = _open_cells(pictures[view], trial, mean, view)
        views.append(np.full(len(xy), view))
        cells.append(xy)
        colours.append(colour)
        if view % PICTURES_AT_ONCE == PICTURES_AT_ONCE - 1:
            yield
    count = sum(len(each) for each in views)
    if count == 0:
        return seen
    return replace(
        seen,
        point=np.concatenate([seen.point, seen.points + np.arange(count)]),
        view=np.concatenate([seen.view, *views]),
        colour=np.concatenate([seen.colour, *colours]),
        z=np.concatenate([seen.z, np.full(count, INFINITE * seen.median_range)]),
        xy=np.concatenate([seen.xy, *cells]),
        ray=_append(seen.ray, count),
        normal=_append(seen.normal, count),
    )


def _append(
    directions: Array | None,  # [M, 3]
    count: int,
) -> Array | None:
    """[M + count, 3]: no lamp reaches where open water is put, whatever its direction."""
    if directions is None:
        return None
    return np.concatenate([directions, np.tile([0.0, 0.0, 1.0], (count, 1))])


def open_area(
    picture: PosedPicture,
    trial: Trial,
    mean: Array,  # [3] of the scene without water
    view: int,
) -> npt.NDArray[np.bool_]:
    """[ceil(H / 2), ceil(W / 2)] where a view's picture shows open water, by that trial."""
    image, z = picture.half_size(), picture.surface_ranges()
    height, width = image.shape[:2]
    lit = gain_map(trial.shading, height, width)[..., None] * np.exp(trial.exposure[view])
    B_inf = gain_map(trial.unevenness, height, width)[..., None] * trial.B_inf
    T = trial.transmission(z.astype(np.float64))
    ground = light_of_ground(mean, T, np.isfinite(z))
    is_open = open_water((image / lit).astype(np.float32), B_inf.astype(np.float32), ground)
    return is_open & picture.shows_scene()


def _open_cells(
    picture: PosedPicture,
    trial: Trial,
    mean: Array,  # [3]
    view: int,
) -> tuple[Array, Array]:
    """Centres [Q, 2] of a view's open cells, each axis from -1 to 1, and mean colours [Q, 3]."""
    image, is_open = picture.half_size(), open_area(picture, trial, mean, view)
    height, width = is_open.shape
    xy, colours = [], []
    for rows in np.array_split(np.arange(height), ROWS):
        for columns in np.array_split(np.arange(width), COLUMNS):
            cell = np.ix_(rows, columns)
            if is_open[cell].all() and _is_even(image[cell]):
                centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
                xy.append(centre / (0.5 * width, 0.5 * height) - 1.0)
                colours.append(image[cell].mean(axis=(0, 1)))
    return np.array(xy).reshape(-1, 2), np.array(colours, np.float64).reshape(-1, 3)


def _is_even(
    cell: npt.NDArray[np.float32],  # [h, w, 3]
) -> bool:
    """True if its brightness changes as open water's does: evenly, or not at all."""
    blocks = cv2.resize(cell, (BLOCKS, BLOCKS), interpolation=cv2.INTER_AREA).mean(axis=-1)
    at = np.linspace(-1.0, 1.0, BLOCKS)
    plane = [np.ones((BLOCKS, BLOCKS)), np.tile(at, (BLOCKS, 1)), np.tile(at, (BLOCKS, 1)).T]
    A = np.stack(plane, axis=-1).reshape(-1, 3)
    values = blocks.reshape(-1).astype(np.float64)
    residuals = values - A @ np.linalg.lstsq(A, values, rcond=None)[0]
    return bool(residuals.std() < MOST_UNEVEN * values.mean())


# --------------------------------------------------------------------------------------------------
# Open water in a picture: nothing but backscatter, which ends nowhere.
#
# It has the colour of water seen over any length, B_inf, and no texture. A map has Gaussians there
# like anywhere else, at ranges that mean nothing, so the map's alpha does not tell. Nor does the
# colour: in murky water far ground has it too. Its texture fades with the light that comes back,
# though, and no faster: at any range it is a tenth to a fifth of that light or more, open water's
# is next to nothing.

Image = npt.NDArray[np.float32]

WINDOW_PX = 9
"""Side of the square in which texture is looked for: a few pixels of the coarsest detail."""
LEAST_OF_GROUND = 0.04
"""Texture of ground over the light that usual ground at its range returns. Median of the nearest
quarter of a view: 0.10 to 0.22 on seven real clips and two rendered dives, 5 % have less than 0.04
to 0.1; 95 % of what is open on IUI3 and Curasao have less than 0.03."""
MOST_TEXTURE = 0.012
"""Three grey levels, what compression leaves in smooth areas: more is texture at any range."""
NOISE_SHARE, LEAST_NOISE = 0.01, 0.003
"""Of the picture's pixels, those with the least texture show its noise; and what compression leaves
at least, under a grey level: open water of Curasao has 0.003 on the median, IUI3's 0.002."""
RELATIVE_DIFFERENCE, DIFFERENCE = 0.3, 0.03
"""How far a channel may be from B_inf, relative and absolute: sunlit water is not as bright all
over the picture."""
LEAST_AREA, LEAST_MATCH = 0.01, 0.5
"""Of a connected smooth area: share of the picture, and share of its pixels with that colour."""


def light_of_ground(
    mean: Array,  # [3] of the scene without water
    T: npt.NDArray[np.floating],  # [H, W, 3] transmission at the map's range
    solid: npt.NDArray[np.bool_],  # [H, W] where it has one
) -> Image:
    """[H, W] what usual ground there would return, mean of RGB; infinite where no range is known:
    what has no texture there is no ground."""
    light = T @ (mean / 3.0)
    return np.where(solid, light, np.inf).astype(np.float32)


def open_water(
    image: Image,  # [H, W, 3] evenly lit
    B_inf: Image,  # [H, W, 3] the backscatter at infinity, as it looks at each pixel
    ground: Image,  # [H, W] as of light_of_ground
) -> npt.NDArray[np.bool_]:
    """[H, W] True where the picture shows open water."""
    texture = _texture(image.mean(axis=-1))
    noise = np.float32(max(float(np.quantile(texture, NOISE_SHARE)), LEAST_NOISE))
    limit = np.minimum(np.hypot(LEAST_OF_GROUND * ground, noise), np.float32(MOST_TEXTURE))
    smooth = texture < limit
    off = np.abs(cv2.boxFilter(image, -1, (WINDOW_PX, WINDOW_PX)) - B_inf)
    alike = (off < RELATIVE_DIFFERENCE * B_inf + DIFFERENCE).all(axis=-1)
    count, area_of = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=8)
    pixels = np.bincount(area_of.reshape(-1), minlength=count)
    matching = np.bincount(area_of.reshape(-1), alike.reshape(-1), count)
    kept = (pixels > LEAST_AREA * smooth.size) & (matching > LEAST_MATCH * pixels)
    kept[0] = False  # what is not smooth
    return np.asarray(kept[area_of])


def _texture(
    grey: Image,  # [H, W]
) -> Image:
    """[H, W] deviation of the brightness in the window from a plane: the water's own changes
    slowly over the picture."""
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.boxFilter(grey, -1, window)
    variance = cv2.boxFilter(grey * grey, -1, window) - mean * mean
    at = np.arange(WINDOW_PX, dtype=np.float32) - WINDOW_PX // 2
    along, across = at / WINDOW_PX, np.full(WINDOW_PX, 1.0 / WINDOW_PX, np.float32)
    slopes = (cv2.sepFilter2D(grey, -1, *pair) for pair in ((along, across), (across, along)))
    explained = sum(slope * slope for slope in slopes) / np.float32((at * at).mean())
    return np.sqrt(np.maximum(variance - explained, 0.0))
