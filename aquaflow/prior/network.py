"""What a network is to the hybrid prior: a describer of pictures, and what it says of ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, Mask, RangeUnit
from aquaflow.prior.dense_matching import DenseViews

Picture = npt.NDArray[np.uint8]
Half = npt.NDArray[np.float16]

Described: TypeAlias = Literal["nothing", "cells", "pixels"]
"""What of a picture a network gives descriptors of: nothing (it knows ranges only), cells, or all
pixels, with their points in the other picture's frame."""

METRIC_SIGMA = 0.1
"""Relative error of the metre of a metric network; assumed, none was run here with real weights."""
SHORTEST = 1e-6
"""Length below which a descriptor has no direction."""


class ComparedPair(Protocol):
    """What a network says of two pictures; computed when first asked for, and kept."""

    @property
    def cells(self) -> tuple[Float, Float] | None:
        """[rows, columns, d] unit descriptors of cells that cover each picture; None of a network
        that only knows ranges."""
        ...

    def dense(self, back: bool = False) -> DenseViews | None:
        """Points and descriptors of all pixels, to match the first picture in the second, or
        ``back``; None of a network that does not give them, or not of this pair."""
        ...

    @property
    def range_a(self) -> LearnedRange:
        """Distances in the first picture, from its own camera."""
        ...

    @property
    def range_b(self) -> LearnedRange:
        """Distances in the second picture, from its own camera."""
        ...

    @property
    def confidence(self) -> Float | None:
        """[rows, columns] in [0, 1] of matches of the first picture's cells; None: it has none."""
        ...


class Describer(Protocol):
    """A network that describes pictures: their cells, by which they match, or their ranges only."""

    name: str
    metric: bool
    describes: Described
    range_unit: RangeUnit
    unit_sigma: float
    """As of the prior."""

    def fit(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] the picture at a size that the network takes."""
        ...

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """What is computed once for a picture and kept with it."""
        ...

    def compare(
        self,
        a: Half,  # [...] features of one picture
        b: Half,  # [...] of the other
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> ComparedPair:
        """What it says of the pair; cameras are those of the pictures before fitting."""
        ...


def unit(
    descriptors: Float,  # [..., d]
) -> Float:
    """[..., d] of length 1."""
    length = np.linalg.norm(descriptors, axis=-1, keepdims=True)
    return np.asarray(descriptors / np.maximum(length, SHORTEST), dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Ranges that a network gives without parallax, as the contract's pointmap X and confidence Q.

LEAST_VARIANCE = 1e-4
"""Of the logarithm of a range: no network knows it better than to a hundredth."""
MOST_LOG = 30.0
"""Logarithm beyond which a range or variance is nonsense; e^30 m is still a number."""

LEAST_WEIGHT = 0.25
"""Bilinear weight of the cells with sound numbers from which a pixel is known: its own cell's."""


@dataclass(frozen=True)
class LearnedRange:
    """What a network says of the distances in a picture; cells cover it evenly."""

    log_range: Float
    """[rows, columns] natural logarithm; NaN where it does not know"""
    variance: Float
    """[rows, columns] of log_range"""

    def pointmap(self, camera: CameraModel) -> tuple[Float, Float]:
        """X [H, W, 3] in the camera's frame, and Q [H, W]: linear between the cells' centres that
        have sound numbers. Where there are none around, NaN and 0."""
        height, width = camera.height, camera.width
        sound = np.isfinite(self.log_range) & np.isfinite(self.variance)
        sound &= (np.abs(np.where(sound, self.log_range, 0.0)) < MOST_LOG) & (self.variance > 0.0)
        variance = np.clip(self.variance, LEAST_VARIANCE, np.exp(MOST_LOG))
        weight = spread_over(sound, height, width).astype(np.float64)
        known = weight > LEAST_WEIGHT
        weight = np.where(known, weight, 1.0)
        log_range = spread_over(np.where(sound, self.log_range, 0.0), height, width) / weight
        log_variance = spread_over(np.log(np.where(sound, variance, 1.0)), height, width) / weight
        Q = np.exp(-np.where(known, log_variance, 0.0))
        rays = camera.unproject(camera.pixel_centres())
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        distance = np.exp(np.where(known, log_range, 0.0))
        X = np.where(known[..., None], rays * distance[..., None], np.nan)
        return X.astype(np.float32), np.where(known, Q, 0.0).astype(np.float32)


def cell_rays(camera: CameraModel, rows: int, columns: int) -> Float:
    """[rows, columns, 2] x / z and y / z of the centres of cells that cover the picture."""
    v, u = np.mgrid[:rows, :columns] + 0.5
    pixels = np.stack([u * camera.width / columns, v * camera.height / rows], -1)
    return camera.unproject(pixels)[..., :2].astype(np.float32)


def spread_over(
    cells: npt.NDArray[np.floating] | Mask,  # [rows, columns]
    height: int,
    width: int,
) -> Float:
    """[height, width] linear between the cells' centres."""
    return np.asarray(cv2.resize(cells.astype(np.float32), (width, height)), dtype=np.float32)
