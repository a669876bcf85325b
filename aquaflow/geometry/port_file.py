"""The key ``port`` of ``camera.yaml``: a flat port or a dome with its measures."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, model_validator

from aquaflow.geometry.port import ACRYLIC, REFERENCE_RANGE_M, DomePort, FlatPort, Port, Triple
from aquaflow.geometry.water_index import (
    FRESH_WATER,
    GREEN_NM,
    SEA_SALINITY_PSU,
    SEA_WATER,
    TEMPERATURE_C,
    water_index,
)

GLASSES = {"acrylic": ACRYLIC, "glass": 1.52, "polycarbonate": 1.59, "sapphire": 1.77}
"""Refractive indexes at 550 nm; glass is borosilicate crown (BK7)."""
WATERS = {"sea": SEA_WATER, "fresh": FRESH_WATER}
"""At the surface, of 10 degrees C."""
MOST_TILT = np.cos(np.radians(45.0))
"""Cosine between the optical axis and the normal of a flat port that a camera looks through."""

MISSING = {
    "flat": "port: flat lacks its measures; write port: {kind: flat, distance_m: ..., "
    "thickness_m: ...} as in docs/camera.md, or port: none for a camera calibrated in water",
    "dome": "port: dome lacks its measures; write port: {kind: dome, radius_m: ..., "
    "thickness_m: ..., centre_m: [x, y, z]} as in docs/camera.md, or port: none for a camera "
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
        """For computing; the normal is made a unit vector."""
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
        """For computing."""
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
    """For computing."""
    return None if file is None else file.port()
