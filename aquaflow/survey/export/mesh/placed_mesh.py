"""A mesh as it is written: coordinates for other programs, colours, and what all of it means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.dive.placement import Placement
from aquaflow.survey.export.mesh.atlas import AtlasLayout

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Texture:
    """A picture of the surface, and where in it each corner of the triangles lies."""

    layout: AtlasLayout
    picture: Bytes
    """[H, W, 3] RGB."""


@dataclass(frozen=True)
class PlacedMesh:
    """Triangles in the axes of :mod:`aquaflow.dive.placement`, on the UTM grid where there is
    one."""

    positions: Array
    """[N, 3] less ``origin``: small numbers, which float32 resolves."""
    normals: Array
    """[N, 3] unit."""
    faces: Integers
    """[M, 3] counter-clockwise seen from outside."""
    sigma: Array
    """[N] as in :func:`aquaflow.survey.export.mesh.seen_places.place_sigmas`."""
    origin: tuple[float, float, float]
    """To be added to the positions; zeros without a grid."""
    where: Placement
    seen: str
    """``without water``, or through how much of it."""

    def facts(self, y_up: bool = False) -> dict[str, Any]:
        """What coordinates and colours mean, for machines; ``y_up``: of a file with x, z, -y."""
        return {
            "unit": self.where.unit,
            "axes": self.where.in_words(y_up),
            "epsg": self.where.epsg,
            "origin": list(self.origin),
            "colours": self.seen,
        }

    def comments(self) -> list[str]:
        """The same in lines of ASCII."""
        origin = " ".join(f"{value:.3f}" for value in self.origin)
        return [
            f"written by AquaFlow {__version__}",
            f"axes: {self.where.in_words()}",
            f"unit: {self.where.unit}",
            f"add to the coordinates: {origin}",
            f"colours: {self.seen}",
        ]
