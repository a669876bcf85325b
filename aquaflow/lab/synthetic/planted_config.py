"""What may have changed on a synthetic sea floor from one dive to a later visit."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["Bleached", "PlantedObject"]


class PlantedObject(BaseModel):
    """An object that stands on the floor besides those of the scene: added, removed or moved where
    two days differ in it."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["box", "ball"] = Field("box", description="a cube, or a sphere")
    at_m: tuple[float, float] = Field(description="m, x and y of its middle, survey frame")
    half_m: float = Field(0.1, gt=0.0, le=1.0, description="m, half an edge, or the radius")
    turn_deg: float = Field(20.0, description="degrees about the vertical")
    paint: tuple[float, float, float] = Field(
        (0.55, 0.40, 0.18), description="albedo RGB; a wooden crate"
    )
    pattern_m: float = Field(
        0.4, ge=0.0, description="m, where in the paint's texture it begins; stays with the object"
    )


class Bleached(BaseModel):
    """A round patch of the floor that has lost its colour."""

    model_config = ConfigDict(extra="forbid")

    at_m: tuple[float, float] = Field(description="m, x and y of its middle, survey frame")
    radius_m: float = Field(0.2, gt=0.0, le=2.0, description="m")
    share: float = Field(
        0.8, gt=0.0, le=1.0, description="of the way from its own colour to white of its shade"
    )
