"""A view's picture at every scale, with the range that the map has in it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from torch import Tensor

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View

Array = npt.NDArray[np.float64]

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
