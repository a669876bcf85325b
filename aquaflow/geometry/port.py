"""Windows between camera and water: what is measured of a flat port and of a dome.

Lengths are metres in the camera's frame, whose origin is the centre of projection in air.
Refractive indexes are relative to the air inside the housing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.water_index import SEA_WATER

ACRYLIC = 1.49
"""Refractive index of PMMA, of which most ports of small vehicles are."""
REFERENCE_RANGE_M = 1.0
"""Default distance at which rectified pictures are exact: the harmonic middle of 0.6 and 3 m, where
small vehicles look (docs/camera.md)."""

Triple: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class FlatPort:
    """A plane window."""

    distance_m: float
    """From the centre of projection to the inner face, along the normal."""
    thickness_m: float
    glass: float = ACRYLIC
    water: float = SEA_WATER
    normal: Triple = (0.0, 0.0, 1.0)
    """Unit vector to the water; the optical axis if the port is not tilted."""
    range_m: float = REFERENCE_RANGE_M
    """Distance along the optical axis at which rectified pictures are exact."""
    kind: Literal["flat"] = "flat"

    @property
    def axis(self) -> npt.NDArray[np.float64]:
        """[3] unit vector of the line through the centre of projection that every ray meets."""
        return np.array(self.normal)

    def align(self) -> FlatPort:
        """The same port seen in axes whose z is :attr:`axis`."""
        return FlatPort(self.distance_m, self.thickness_m, self.glass, self.water)


@dataclass(frozen=True)
class DomePort:
    """A window between two concentric spheres."""

    radius_m: float
    """Of the inner sphere."""
    thickness_m: float
    centre_m: Triple = (0.0, 0.0, 0.0)
    """Of the spheres; zero if the centre of projection lies there, as it should."""
    glass: float = ACRYLIC
    water: float = SEA_WATER
    range_m: float = REFERENCE_RANGE_M
    """Distance along the optical axis at which rectified pictures are exact."""
    kind: Literal["dome"] = "dome"

    @property
    def axis(self) -> npt.NDArray[np.float64]:
        """[3] unit vector of the line through the centre of projection that every ray meets.

        It points forward; of a centred dome any line is one, and this is the optical axis.
        """
        centre = np.array(self.centre_m)
        offset = float(np.linalg.norm(centre))
        if offset == 0.0:
            return np.array([0.0, 0.0, 1.0])
        return centre / (offset if centre[2] >= 0.0 else -offset)

    def align(self) -> DomePort:
        """The same port seen in axes whose z is :attr:`axis`."""
        along = (0.0, 0.0, float(self.axis @ np.array(self.centre_m)))
        return DomePort(self.radius_m, self.thickness_m, along, self.glass, self.water)


Port: TypeAlias = FlatPort | DomePort
