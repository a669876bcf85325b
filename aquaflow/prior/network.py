"""What a network is to the hybrid prior: a describer of pictures, and what it says of two."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.prior.learned_range import LearnedRange

Picture = npt.NDArray[np.uint8]
Half = npt.NDArray[np.float16]

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
    describes: bool
    """False: it knows ranges only."""
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
