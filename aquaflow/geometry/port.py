"""Windows between camera and water: what is measured of a flat port and of a dome.

Lengths are metres in the camera's frame, whose origin is the centre of projection in air.
Refractive indexes are relative to the air inside the housing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Discriminator, Field, model_validator

# --------------------------------------------------------------------------------------------------
# The refractive index of water, relative to the air inside a housing.

GREEN_NM = 550.0
"""Wavelength, nm, at which a colour camera in water sees most of its detail."""
DECIBAR_PER_METRE = 1.0076
"""Hydrostatic pressure of sea water of 1027 kg/m^3."""
COMPRESSIBILITY_PER_DBAR = 4.4e-6
"""Of sea water at 10 degrees C: 4.4e-10 per Pa (UNESCO 1983, equation of state)."""

SEA_SALINITY_PSU = 35.0
"""Of the open ocean."""
TEMPERATURE_C = 10.0
"""Between a Norwegian winter and a summer in Kobe; 10 degrees C change the index by 0.0009."""


def water_index(
    salinity_psu: float = SEA_SALINITY_PSU,
    temperature_c: float = TEMPERATURE_C,
    depth_m: float = 0.0,
    wavelength_nm: float = GREEN_NM,
) -> float:
    """Refractive index of water relative to air.

    At the surface by X. Quan and E. S. Fry, "Empirical equation for the index of refraction of
    seawater", Applied Optics 34 (1995) 3477, good to 1.5e-5 for 0 to 35 psu, 0 to 30 degrees C and
    400 to 700 nm. Below, the law of Gladstone and Dale, that n - 1 grows as the density, which
    pressure raises: 0.0015 per 1000 m, as the tables of Austin and Halikas (1976) have it.
    """
    S, T, wave = salinity_psu, temperature_c, wavelength_nm
    n = (
        1.31405
        + (1.779e-4 - 1.05e-6 * T + 1.6e-8 * T**2) * S
        - 2.02e-6 * T**2
        + (15.868 + 0.01155 * S - 0.00423 * T) / wave
        - 4382.0 / wave**2
        + 1.1455e6 / wave**3
    )
    denser = 1.0 + COMPRESSIBILITY_PER_DBAR * DECIBAR_PER_METRE * depth_m
    return 1.0 + denser * (n - 1.0)


SEA_WATER = water_index()
FRESH_WATER = water_index(salinity_psu=0.0)


# --------------------------------------------------------------------------------------------------
# The ports.

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


# --------------------------------------------------------------------------------------------------
# The key ``port`` of ``camera.yaml``: a flat port or a dome with its measures.

GLASSES = {"acrylic": ACRYLIC, "glass": 1.52, "polycarbonate": 1.59, "sapphire": 1.77}
"""Refractive indexes at 550 nm; glass is borosilicate crown (BK7)."""
WATERS = {"sea": SEA_WATER, "fresh": FRESH_WATER}
"""At the surface, of 10 degrees C."""
MOST_TILT = np.cos(np.radians(45.0))
"""Cosine between the optical axis and the normal of a flat port that a camera looks through."""

MISSING = {
    "flat": "port: flat lacks its measures; write port: {kind: flat, distance_m: ..., "
    "thickness_m: ...}, or port: none for a camera calibrated in water",
    "dome": "port: dome lacks its measures; write port: {kind: dome, radius_m: ..., "
    "thickness_m: ..., centre_m: [x, y, z]}, or port: none for a camera "
    "calibrated in water",
}
"""What is said of a port that is only named."""


Numbers = Annotated[list[float], Field(min_length=3, max_length=3)]


class WaterFile(BaseModel):
    """What the refractive index of water follows from."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    salinity_psu: float = Field(SEA_SALINITY_PSU, ge=0, le=45)
    temperature_c: float = Field(TEMPERATURE_C, ge=-2, le=40)
    depth_m: float = Field(0.0, ge=0, le=11_000)
    wavelength_nm: float = Field(GREEN_NM, ge=400, le=700)

    @property
    def index(self) -> float:
        """Refractive index."""
        return water_index(**self.model_dump())


class _PortFile(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    glass: (
        Annotated[float, Field(ge=1, le=2.5)]
        | Literal["acrylic", "glass", "polycarbonate", "sapphire"]
    ) = "acrylic"
    water: Annotated[float, Field(ge=1, le=1.5)] | Literal["sea", "fresh"] | WaterFile = "sea"
    range_m: float = Field(REFERENCE_RANGE_M, gt=0, le=1000)

    @property
    def glass_index(self) -> float:
        """Refractive index of the glass."""
        return GLASSES[self.glass] if isinstance(self.glass, str) else self.glass

    @property
    def water_index(self) -> float:
        """Refractive index of the water."""
        if isinstance(self.water, WaterFile):
            return self.water.index
        return WATERS[self.water] if isinstance(self.water, str) else self.water


class FlatPortFile(_PortFile):
    """A plane window."""

    kind: Literal["flat"]
    distance_m: float = Field(ge=0, le=1)
    thickness_m: float = Field(ge=0, le=0.5)
    normal: Numbers = [0.0, 0.0, 1.0]

    @model_validator(mode="after")
    def _is_looked_through(self) -> FlatPortFile:
        length = float(np.linalg.norm(self.normal))
        if length == 0.0 or self.normal[2] < MOST_TILT * length:
            raise ValueError("the normal of the port must lie within 45 degrees of [0, 0, 1]")
        if self.range_m <= self.distance_m + self.thickness_m:
            raise ValueError("range_m lies inside the housing")
        return self

    def port(self) -> FlatPort:
        """The port to compute with; the normal is made a unit vector."""
        normal = np.array(self.normal)
        length = float(np.linalg.norm(normal))
        # A vector that is one already keeps every bit.
        unit = _triple((normal if abs(length - 1.0) < 1e-12 else normal / length).tolist())
        indexes = self.glass_index, self.water_index
        return FlatPort(self.distance_m, self.thickness_m, *indexes, unit, self.range_m)


class DomePortFile(_PortFile):
    """A window between two concentric spheres."""

    kind: Literal["dome"]
    radius_m: float = Field(gt=0, le=2)
    thickness_m: float = Field(ge=0, le=0.5)
    centre_m: Numbers = [0.0, 0.0, 0.0]

    @model_validator(mode="after")
    def _holds_the_camera(self) -> DomePortFile:
        if float(np.linalg.norm(self.centre_m)) >= self.radius_m:
            raise ValueError("centre_m is farther away than radius_m: the camera must be inside")
        if self.range_m <= self.radius_m + self.thickness_m + self.centre_m[2]:
            raise ValueError("range_m lies inside the housing")
        return self

    def port(self) -> DomePort:
        """The port to compute with."""
        indexes = self.glass_index, self.water_index
        centre = _triple(self.centre_m)
        return DomePort(self.radius_m, self.thickness_m, centre, *indexes, self.range_m)


def _triple(numbers: list[float]) -> Triple:
    x, y, z = numbers
    return (x, y, z)


PortFile = Annotated[FlatPortFile | DomePortFile, Discriminator("kind")]


def as_stated(value: Any) -> Any:
    """A port as a file states it, none of them None.

    Raises:
        ValueError: it is named without its measures, or is of no kind.
    """
    if value is None or value == "none":
        return None
    if isinstance(value, str) and value in MISSING:
        raise ValueError(MISSING[value])
    if not isinstance(value, dict) or value.get("kind") not in MISSING:
        raise ValueError("it is none, or has kind: flat or kind: dome with its measures")
    return value


def port_of(file: FlatPortFile | DomePortFile | None) -> Port | None:
    """The port to compute with."""
    return None if file is None else file.port()
