"""The same patches of the scene's surface in all pictures that show them.

Detail is lost with range: a far pixel covers more of the scene, and its light scatters more. What
is lost that way looks like water if points are compared. So patches are, all of one size in the
world in every view, and so large that the farthest view that shows one still resolves it: on
rendered dives the contrast of patches changes with range by a hundredth of an optical depth or two,
on real clips the water that is found does not depend on their size from 1 to 8 pixels.

A patch is a grid of samples on the surface, lifted from the nearest view by the map's range. Each
sample is looked up in the other views; what is hidden there, or in front of the map's surface, is
no observation.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import cv2
import numpy as np
import numpy.typing as npt
from torch import Tensor

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View
from aquaflow.water.observations import PICTURES_AT_ONCE, Observations

Array = npt.NDArray[np.float64]
Seen = npt.NDArray[np.bool_]

POINTS = 800
"""Patches looked at."""
CANDIDATES = 4000
"""Places on the surface that the patches are drawn from."""
LEAST_SPAN = 0.1
"""Added to the log of largest over smallest range, by which patches are drawn: those seen from near
and far say most, those seen from one range alone something of the scene's colours."""
MIN_VIEWS, MOST_VIEWS = 3, 8
"""Views that must see a patch for it to say anything about the water; and how many of them are
used, from the nearest to the farthest: more say little that is new."""
SIGMA_PX = 2.0
"""Of a patch in the farthest of its views, standard deviation of the Gaussian that weighs it."""
SIDE, REACH = 5, 2.0
"""Samples along a side of the patch's grid, and how many sigmas it reaches to each side."""
SEEN_SHARE = 0.85
"""Of a patch's samples that a view must show."""
CLIPPED = 0.9
"""A sample that is brighter in any channel has clipped pixels; its patch is no observation there.
Taken at its word, what is near looks darker than it is: the errors of a rendered dive with lamps
were three times as large."""
LEAST_TEXTURE = 0.008
"""Deviation of a patch's samples in the nearest of its views, two grey levels. Where there is less,
nothing is known of the range: open water, which a map has anywhere."""


def sighting(
    pictures: Sequence[PosedPicture], random: np.random.Generator
) -> Generator[None, None, Observations]:
    """Observations of a random choice of the surface that several of the pictures, at least one,
    show; with pauses."""
    places, ranges = _draw(pictures, random)
    yield
    samples, sigma = _patches(pictures, places, ranges)
    yield
    colour, z, xy, ray = (np.zeros((*ranges.shape, size)) for size in (3, 1, 2, 3))
    whole_patches = np.asarray(np.isfinite(samples).all(axis=(1, 2)))
    seen = np.isfinite(ranges) & whole_patches[:, None]
    for number, picture in enumerate(pictures):
        own = np.nonzero(seen[:, number])[0]
        *found, whole = _observe(picture, samples[own], sigma[own])
        for table, values in zip((colour, z, xy), found, strict=True):
            table[own, number] = values
        ray[own, number] = picture.rays_to(places[own])
        seen[own, number] = whole
        if number % PICTURES_AT_ONCE == PICTURES_AT_ONCE - 1:
            yield
    seen[seen.sum(axis=1) < MIN_VIEWS] = False
    place, view = np.nonzero(seen)
    used, point = np.unique(place, return_inverse=True)
    return Observations(
        point,
        view,
        colour[place, view],
        z[place, view, 0],
        xy[place, view],
        places[used],
        ray[place, view],
    )


def _draw(pictures: Sequence[PosedPicture], random: np.random.Generator) -> tuple[Array, Array]:
    """Places [P, 3] in the world, and their range [P, V] in the views that are used; inf in
    others."""
    each = -(-CANDIDATES // max(len(pictures), 1))
    places = np.concatenate(
        [np.zeros((0, 3)), *(picture.random_surface(each, random) for picture in pictures)]
    )
    ranges = np.full((len(places), len(pictures)), np.inf)
    for number, picture in enumerate(pictures):
        _, z, seen = picture.locate(places)
        ranges[seen, number] = z[seen]
    several = np.isfinite(ranges).sum(axis=1) >= MIN_VIEWS
    places, ranges = places[several], ranges[several]
    if len(places) > POINTS:
        farthest = np.where(np.isfinite(ranges), ranges, 0.0).max(axis=1)
        weight = LEAST_SPAN + np.log(farthest / ranges.min(axis=1))
        chosen = random.choice(len(places), POINTS, replace=False, p=weight / weight.sum())
        places, ranges = places[chosen], ranges[chosen]
    return places, _over_all_ranges(ranges)


def _over_all_ranges(
    ranges: Array,  # [P, V], inf where not seen
) -> Array:
    """[P, V] with at most MOST_VIEWS of each place left: nearest, farthest, and evenly between."""
    order = np.argsort(ranges, axis=1, kind="stable")
    count = np.isfinite(ranges).sum(axis=1)
    wanted = np.linspace(0.0, 1.0, MOST_VIEWS) * (count - 1)[:, None]
    used = np.take_along_axis(order, np.rint(wanted).astype(np.int64), axis=1)
    kept = np.full_like(ranges, np.inf)
    np.put_along_axis(kept, used, np.take_along_axis(ranges, used, axis=1), axis=1)
    return kept


def _patches(
    pictures: Sequence[PosedPicture],
    places: Array,  # [P, 3] world
    ranges: Array,  # [P, V], inf where not used
) -> tuple[Array, Array]:
    """Samples of each patch [P, K, 3], NaN where its nearest view does not show all of it; and its
    sigma [P], map units."""
    focal = np.array([picture.focal for picture in pictures])
    sigma = np.where(np.isfinite(ranges), ranges / focal, 0.0).max(axis=1) * SIGMA_PX
    nearest = ranges.argmin(axis=1) if len(places) else np.zeros(0, np.int64)
    grid, _ = _grid()
    samples = np.full((len(places), len(grid), 3), np.nan)
    for number, picture in enumerate(pictures):
        own = np.nonzero(nearest == number)[0]
        pixels, z, _ = picture.locate(places[own])
        pixels = pixels[:, None] + (sigma[own] * picture.focal / z)[:, None, None] * grid
        lifted = picture.lift(pixels)
        whole = picture.locate(lifted)[2].all(axis=1)
        colours = picture.sample(pixels, _aperture(picture, sigma[own], z))
        whole &= colours.mean(axis=-1).std(axis=1) > LEAST_TEXTURE
        samples[own[whole]] = lifted[whole]
    return samples, sigma


def _observe(
    picture: PosedPicture,
    samples: Array,  # [N, K, 3] world
    sigma: Array,  # [N] map units
) -> tuple[Array, Array, Array, Seen]:
    """Of each patch colour [N, 3], range [N, 1], place in the picture [N, 2], and whether it is
    seen [N]."""
    _, weight = _grid()
    pixels, z, seen = picture.locate(samples)
    z = z @ weight
    colours = picture.sample(pixels, _aperture(picture, sigma, z))
    colour = np.einsum("k,nkc->nc", weight, colours)
    size = np.array([picture.camera.width, picture.camera.height])
    xy = np.einsum("k,nkc->nc", weight, pixels) / (0.5 * size) - 1.0
    whole = (seen.mean(axis=1) > SEEN_SHARE) & (colours.max(axis=(1, 2), initial=0.0) < CLIPPED)
    return colour, z[:, None], xy, whole


def _aperture(
    picture: PosedPicture,
    sigma: Array,  # [N] of patches, map units
    z: Array,  # [N] their ranges
) -> Array:
    """[N] px that a sample averages: half of what lies between two samples."""
    spacing = 2.0 * REACH / (SIDE - 1) * sigma * picture.focal / z
    return 0.5 * spacing


def _grid() -> tuple[Array, Array]:
    """[K, 2] in sigmas, and the weights [K] of a Gaussian."""
    line = np.linspace(-REACH, REACH, SIDE)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * (grid**2).sum(axis=1))
    return grid, weight / weight.sum()


# --------------------------------------------------------------------------------------------------
# A view's picture at every scale, with the range that the map has in it.

LEVELS = 5
"""Of the pyramid; the last one's pixels are 16 times as wide as the picture's."""
SOLID = 0.5
"""Alpha above which the map's range is that of the surface in the picture."""
AGREEING = 0.05
"""Relative difference of ranges up to which a place is the surface that the map has there, and not
hidden by it."""
BORDER_PX = 1.0
"""Margin within which a pixel's surroundings are not all in the picture."""


class PosedPicture:
    """One view's picture, where it was taken, and the range of what it shows."""

    def __init__(
        self,
        view: View,
        z: Tensor,  # [H, W] range of the map from the view, map units
        alpha: Tensor,  # [H, W] of the map from the view
    ) -> None:
        self.camera: CameraModel = view.camera
        self.T_wc: Sim3 = view.T_wc
        self.focal = float(np.sqrt(view.camera.fx * view.camera.fy))
        """px"""
        self._z = picture_out(z)
        self._shows_scene = picture_out(view.scene_mask())
        self._solid = picture_out(alpha > SOLID) & self._shows_scene
        self._levels = [np.asarray(view.image, np.float32) / np.float32(255.0)]
        while len(self._levels) < LEVELS and min(self._levels[-1].shape[:2]) > LEVELS:
            self._levels.append(np.asarray(cv2.pyrDown(self._levels[-1]), np.float32))
        # Of a sample at each level, px of the picture: the pixel itself, pyrDown's binomial filter
        # (variance 1 at every step), and bilinear interpolation (a sixth of a pixel squared).
        width = 4.0 ** np.arange(len(self._levels))
        filters = np.concatenate([[0.0], np.cumsum(width[:-1])])
        self._apertures = np.sqrt(1.0 / 12.0 + filters + width / 6.0)

    def half_size(self) -> npt.NDArray[np.float32]:
        """[ceil(H / 2), ceil(W / 2), 3] the picture."""
        return self._levels[1]

    def shows_scene(self) -> npt.NDArray[np.bool_]:
        """[ceil(H / 2), ceil(W / 2)] False where the vehicle is."""
        return self._shows_scene[::2, ::2]

    def surface_ranges(self) -> npt.NDArray[np.float32]:
        """[ceil(H / 2), ceil(W / 2)] range of the surface, infinite where the map has none."""
        return np.where(self._solid, self._z, np.float32(np.inf))[::2, ::2]

    def random_surface(
        self,
        count: int,
        random: np.random.Generator,
    ) -> Array:
        """[up to count, 3] places in the world that the picture shows."""
        rows, columns = (random.integers(0, size, count) for size in self._z.shape)
        good = self._solid[rows, columns]
        return self.lift(np.stack([columns[good], rows[good]], axis=-1).astype(np.float64) + 0.5)

    def lift(
        self,
        pixels: Array,  # [..., 2] px
    ) -> Array:
        """[..., 3] the places in the world that the nearest pixels' centres show."""
        columns, rows = self._nearest(pixels)
        rays = self.camera.unproject(np.stack([columns, rows], axis=-1) + 0.5)
        rays *= (self._z[rows, columns] / np.linalg.norm(rays, axis=-1))[..., None]
        return np.asarray(self.T_wc.t + rays @ self.T_wc.R.T)

    def locate(
        self,
        places: Array,  # [..., 3] world
    ) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Where in the picture [..., 2] px, at what range [...], and whether it is seen there."""
        local = (places - self.T_wc.t) @ self.T_wc.R
        z = np.linalg.norm(local, axis=-1)
        ahead = local[..., 2] > 0.0
        pixels = self.camera.project(np.where(ahead[..., None], local, (0.0, 0.0, 1.0)))
        size = np.array([self.camera.width, self.camera.height])
        inside = ((pixels > BORDER_PX) & (pixels < size - BORDER_PX)).all(axis=-1)
        columns, rows = self._nearest(pixels)
        there = np.abs(self._z[rows, columns] - z) < AGREEING * z
        return pixels, z, ahead & inside & there & self._solid[rows, columns]

    def rays_to(
        self,
        places: Array,  # [N, 3] world
    ) -> Array:
        """[N, 3] unit, camera axes."""
        ray = (places - self.T_wc.t) @ self.T_wc.R
        return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))

    def sample(
        self,
        pixels: Array,  # [N, K, 2] px
        aperture: Array,  # [N] px, standard deviation of what one sample averages
    ) -> Array:
        """[N, K, 3] the picture around ``pixels``, between the two nearest levels."""
        wanted = np.clip(aperture, self._apertures[0], self._apertures[-1])
        lower = np.clip(np.searchsorted(self._apertures, wanted) - 1, 0, len(self._levels) - 2)
        low, high = self._apertures[lower] ** 2, self._apertures[lower + 1] ** 2
        share = (wanted**2 - low) / (high - low)
        colours = np.zeros((*pixels.shape[:2], 3))
        for level, picture in enumerate(self._levels):
            weight = np.where(lower == level, 1.0 - share, np.where(lower + 1 == level, share, 0.0))
            own = np.nonzero(weight)[0]
            if len(own) == 0:
                continue
            x, y = ((pixels[own, :, axis] - 0.5) / 2.0**level for axis in (0, 1))
            at = x.astype(np.float32), y.astype(np.float32)
            found = cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colours[own] += weight[own, None, None] * found
        return colours

    def _nearest(
        self,
        pixels: Array,  # [..., 2] px
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Column and row, each [...]; at the edge for what is outside."""
        bounded = np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)
        columns, rows = (
            np.clip(bounded[..., axis], 0, size - 1).astype(np.int64)
            for axis, size in enumerate((self.camera.width, self.camera.height))
        )
        return columns, rows
