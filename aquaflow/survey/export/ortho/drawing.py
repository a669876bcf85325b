"""Tiles of the map as seen from straight above, drawn by the map's own renderer.

The renderer has a perspective camera. One that stands high above a tile, with a focal length that
gives the tile's pixels, sees it as a parallel projection does: a point that lies w from the middle
of a tile and h above its other points moves by w h / D. Lengths are pixels of the tile, counted
from its middle, so that float32 rounds places by far less than a pixel wherever the dive is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from aquaflow.dive.map_file import splats_of
from aquaflow.dive.shown_views import ShownViews
from aquaflow.mapping.appearance import shown_tone
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import mean_water, restored_radiance, to_bytes
from aquaflow.mapping.spatial_index import SpatialIndex
from aquaflow.render.contract import Renderer
from aquaflow.render.limits import RADIUS_SIGMAS
from aquaflow.render.transfers import checkpoint_in, picture_out, pose_in, water_in
from aquaflow.survey.export.ortho.grid import Grid, GridTile
from aquaflow.survey.export.ortho.ground import Ground
from aquaflow.water.tone import ShownTone

Array = npt.NDArray[np.float64]

DISTANCE = 4096.0
"""Of the camera from the middle of a tile's Gaussians, over the larger of the tile's half diagonal
and their half height: points shift by w / 4096, 0.06 px at the edge of a tile, and the order in
which Gaussians lie is known to 1 / 4096 of that size, which is float32's rounding of the
distance."""
MOST_FINER = 4
"""Drawn pixels along a pixel of the raster: 2048 a tile, 100 MB while one is drawn."""
LEAST_ALPHA = 1e-3
"""Divisor of colour and height where next to nothing is."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""Axes of the camera (x right, y down, z forward) that looks down on the ground."""


@dataclass(frozen=True)
class DrawnTile:
    """A tile of the map from above."""

    radiance: Tensor
    """[h, w, 3] clean radiance J, of what is there."""
    alpha: npt.NDArray[np.float32]
    """[h, w] how much of the pixel the map covers."""
    height: Array
    """[h, w] mean height, weighted as the colours are, in the ground's unit."""
    spread: Array
    """[h, w] standard deviation of the heights, weighted likewise: large at edges."""


class GroundSplats:
    """The Gaussians of a map on the ground, without those in open water."""

    def __init__(self, shown: ShownViews, ground: Ground) -> None:
        """With a decoder, each Gaussian is as the view nearest to it sees it."""
        mapper = shown.mapper
        self._renderer: Renderer = mapper.renderer
        splats = splats_of(mapper)
        if mapper.medium.active:
            splats = splats.rows(~shown.in_open_water(splats.means))
        self._splats = splats.transform(ground.T_gm)
        sigmas = self._splats.scales.max(axis=1, initial=0.0)
        self._reach = RADIUS_SIGMAS * sigmas
        self._index = SpatialIndex(self._splats.means, sigmas)

    @property
    def places(self) -> Array:
        """[N, 2] x and y of the Gaussians on the ground."""
        return np.asarray(self._splats.means[:, :2], np.float64)

    def reaching(self, grid: Grid, tile: GridTile) -> npt.NDArray[np.intp]:
        """[M] numbers of the Gaussians that touch a tile."""
        low, high = grid.bounds(tile)
        near = self._index.in_box(low - grid.pixel, high + grid.pixel, RADIUS_SIGMAS)
        places, reach = self._splats.means[near, :2], self._reach[near, None] + grid.pixel
        touched = ((places > low - reach) & (places < high + reach)).all(axis=1)
        return np.asarray(near[touched])

    @torch.no_grad()
    def draw(
        self,
        grid: Grid,
        tile: GridTile,
        chosen: npt.NDArray[np.intp],  # [M] of the Gaussians
        finer: int = 1,
    ) -> DrawnTile:
        """A tile, of which ``finer`` x ``finer`` drawn pixels make one."""
        low, high = grid.bounds(tile)
        heights = self._splats.means[chosen, 2]
        middle = np.array([*(0.5 * (low + high)), 0.5 * (heights.min() + heights.max())])
        unit = grid.pixel / finer
        places = (self._splats.means[chosen] - middle) / unit
        width, height = tile.width * finer, tile.height * finer
        far = DISTANCE * max(0.5 * np.hypot(width, height), float(np.abs(places[:, 2]).max()))
        z = places[:, 2:]
        values = np.hstack([self._splats.colours[chosen], z])
        squares = np.hstack([z**2, z, z])  # the renderer takes three colours at least
        drawn = self._image(places, values, chosen, unit, far, width, height)
        square, alpha = self._image(places, squares, chosen, unit, far, width, height)
        together = torch.cat([drawn[0], square[..., :1], alpha[..., None]], dim=-1)
        if finer > 1:
            together = avg_pool2d(together.permute(2, 0, 1)[None], finer)[0].permute(1, 2, 0)
        image = together[..., :5] / together[..., 5:].clamp_min(LEAST_ALPHA)
        mean = picture_out(image[..., 3]).astype(np.float64)
        variance = picture_out(image[..., 4]) - mean**2
        return DrawnTile(
            image[..., :3],
            picture_out(together[..., 5]),
            middle[2] + unit * mean,
            unit * np.sqrt(np.maximum(variance, 0.0)),
        )

    def _image(
        self,
        places: Array,  # [M, 3] px from the tile's middle, ground axes
        values: npt.NDArray[np.floating],  # [M, C] to draw
        chosen: npt.NDArray[np.intp],  # [M]
        unit: float,
        far: float,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        """The values premultiplied [H, W, C], and alpha [H, W]."""
        splats, device = self._splats, self._renderer.device

        def to_device(values: npt.NDArray[np.floating]) -> Tensor:  # [M, ...]
            return checkpoint_in(np.ascontiguousarray(values, np.float32), device)

        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[2, 3] = FLIP, far
        K = np.array([[far, 0.0, 0.5 * width], [0.0, far, 0.5 * height], [0.0, 0.0, 1.0]])
        drawn = self._renderer(
            to_device(places),
            to_device(splats.wxyz[chosen]),
            to_device(splats.scales[chosen] / unit),
            to_device(splats.opacities[chosen]),
            to_device(values),
            pose_in(viewmat, device),
            pose_in(K, device),
            width,
            height,
        )
        return drawn.image, drawn.alpha


# --------------------------------------------------------------------------------------------------
# What colours an ortho shows: the scene without its water, or through a stated depth of it.
#
# Without water, a pixel is what restoration makes of it at the range from which the nearest view
# saw it (mapping/restoration.py): no channel is amplified beyond what its light there allows, and a
# channel of which the pictures had too little follows the others.


class Colours:
    """Turns a map's radiance into the colours of an ortho."""

    def __init__(self, mapper: Mapper, unit: float, water_range: float | None) -> None:
        """``unit``: of the ground's lengths for each map unit; ``water_range``: of the water to
        look through, in the ground's unit, or None for no water."""
        self._scene, self._unit, self._through = mapper.scene, unit, water_range
        self._water = mean_water(mapper.scene, mapper.views)
        self._tone = shown_tone(mapper) if water_range is None else ShownTone()

    @property
    def device(self) -> torch.device:
        """Of the map, and of the radiance that is handed in."""
        return self._scene.device

    @torch.no_grad()
    def of(
        self,
        radiance: Tensor,  # [h, w, 3] J
        nearest: Array,  # [h, w] range of the nearest view, ground's unit; infinite: none
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Colours [h, w, 3], and what share of them was restored from light [h, w] in [0, 1]."""
        sure = np.ones(nearest.shape, np.float32)
        if self._water is None:
            return to_bytes(self._tone.of(picture_out(radiance))), sure
        seen_from = nearest if self._through is None else np.full(nearest.shape, self._through)
        z = np.where(np.isfinite(seen_from), seen_from, 0.0) / self._unit
        ranges = water_in(z, radiance.device)
        if self._through is not None:
            water = self._water
            seen = radiance * water.transmission(ranges) + water.backscatter(ranges)
            return to_bytes(picture_out(seen)), sure
        recovered = restored_radiance(self._scene, radiance, ranges, self._water)
        return (
            to_bytes(self._tone.of(picture_out(recovered.picture))),
            picture_out(recovered.confidence).astype(np.float32),
        )
