"""What an oracle says of every pixel of a pair, as a network with points and descriptors would.

Points of both pictures are in the second one's frame. Their ranges are off, smoothly, by a stated
share, the first one's also across their rays: so far a network's views of one scene lie apart.
Descriptors are alike over widths from pixels to a fifth of the picture, and have noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Float
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.network import unit

FEATURES = 24
"""Numbers of a descriptor, as the paper's network has them."""
WIDTHS_PX = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Distances of two points, in pixels at the median range, over which parts of their descriptors
turn; each has as many numbers."""
NOISE = 0.1
"""Length of a descriptor's noise, over its own (assumed, for no network was run here): matches that
agree both ways are then off by 0.36 px, 5 % of them by 1.3 px or more."""
ASIDE = 0.2
"""Error of the first picture's points across their rays, over that along them (assumed)."""
SMOOTH_SHARE = 8
"""The error of points is smooth over the picture's width by this."""
SEED = 7
"""Of directions that points are described along, and of the noise."""


@dataclass(frozen=True)
class DenseOracle:
    """True points of all pixels of a dive's pictures, and the noise of what it says."""

    points: Float
    """[N, H, W, 3] in one frame; NaN where nothing is known"""
    T_wc: list[Sim3]
    """Of each picture's camera."""
    sigma: float
    """Relative error of points"""
    pixel: float
    """Size of a pixel at the median range, in the unit of the points"""

    def views(self, a: int, b: int) -> DenseViews:
        """Of pictures ``a`` and ``b``."""
        to_b = self.T_wc[b].inverse()
        points_a, points_b = (to_b.apply(self.points[each]) for each in (a, b))
        rng = np.random.default_rng([SEED, a, b])
        range_a = np.linalg.norm(points_a, axis=-1, keepdims=True)
        points_a = points_a * np.exp(self.sigma * self._smooth(rng, 1))
        points_a = points_a + ASIDE * self.sigma * range_a * self._smooth(rng, 3)
        points_b = points_b * np.exp(self.sigma * self._smooth(rng, 1))
        descriptors_a, descriptors_b = (self._descriptors(each, rng) for each in (a, b))
        return DenseViews(
            points_a.astype(np.float32), points_b.astype(np.float32), descriptors_a, descriptors_b
        )

    def _smooth(self, rng: np.random.Generator, channels: int) -> npt.NDArray[np.float64]:
        """[H, W, channels] of deviation 1."""
        height, width = self.points.shape[1:3]
        rows, columns = (-(-side * SMOOTH_SHARE // width) + 1 for side in (height, width))
        coarse = rng.normal(size=(rows, columns, channels))
        smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        smooth = smooth.reshape(height, width, channels)
        return np.asarray(smooth / smooth.std(axis=(0, 1)))

    def _descriptors(self, number: int, rng: np.random.Generator) -> Float:
        """[H, W, FEATURES] unit; NaN where nothing is known."""
        frozen = np.random.default_rng(SEED)
        waves = FEATURES // 2
        widths = np.resize(WIDTHS_PX, waves) * self.pixel
        directions = unit(frozen.normal(size=(waves, 3)).astype(np.float32)).T / widths
        phase = self.points[number].astype(np.float64) @ directions
        found = np.concatenate([np.cos(phase), np.sin(phase)], -1) * waves**-0.5
        return unit((found + rng.normal(0.0, NOISE * FEATURES**-0.5, found.shape)).astype("f4"))
