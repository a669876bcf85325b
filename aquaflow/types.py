"""What every source yields: frames and telemetry samples.

Times are CLOCK_MONOTONIC nanoseconds. ``t_ns`` is the moment of exposure or measurement where the
device reports it; ``arrival_ns`` is when the sample reached this process.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel

__all__ = [
    "KINDS",
    "KIND_OF",
    "LENGTHS",
    "STAMP",
    "VALUES",
    "Acceleration",
    "Altitude",
    "AngularRate",
    "Attitude",
    "CameraModel",
    "Depth",
    "Dropped",
    "EncodedPicture",
    "Frame",
    "Lights",
    "Position",
    "TelemetrySample",
    "UtcTime",
    "Velocity",
    "values_of",
]


@dataclass(frozen=True)
class EncodedPicture:
    """A picture's bytes as the camera or the file had them, for the recorder."""

    format: Literal["jpeg", "png", "webp", "h264"]
    data: bytes
    """A whole file, or for h264 one access unit (Annex B)."""
    key: bool = True
    """True if it can be decoded without those before it."""


@dataclass(frozen=True)
class Frame:
    """One picture, as a source hands it over."""

    index: int
    """Position in the source, counted before any sub-sampling."""
    t_ns: int
    arrival_ns: int
    image: npt.NDArray[np.uint8]
    """[H, W, 3] RGB."""
    camera: CameraModel
    exposure_s: float | None = None
    gain: float | None = None
    mask: npt.NDArray[np.bool_] | None = None
    """[H, W], True where the pixel shows the scene (False: vehicle frame, gripper)."""
    encoded: EncodedPicture | None = None
    """What ``image`` was decoded from, where the source keeps it."""


@dataclass(frozen=True)
class Dropped:
    """A picture that could not be used; the dive goes on without it."""

    index: int
    t_ns: int
    reason: str


@dataclass(frozen=True)
class Depth:
    """Metres below the surface, positive down."""

    t_ns: int
    arrival_ns: int
    source: str
    depth_m: float


@dataclass(frozen=True)
class Attitude:
    """Rotation of the body (forward, right, down) in NED, wxyz."""

    t_ns: int
    arrival_ns: int
    source: str
    wxyz: tuple[float, float, float, float]


@dataclass(frozen=True)
class AngularRate:
    """Body frame, rad/s."""

    t_ns: int
    arrival_ns: int
    source: str
    rate_rad_s: tuple[float, float, float]


@dataclass(frozen=True)
class Acceleration:
    """Specific force in the body frame, m/s^2."""

    t_ns: int
    arrival_ns: int
    source: str
    acceleration_m_s2: tuple[float, float, float]


@dataclass(frozen=True)
class Velocity:
    """Velocity over ground in the body frame, m/s, with the device's figure of merit (1 sigma)."""

    t_ns: int
    arrival_ns: int
    source: str
    velocity_m_s: tuple[float, float, float]
    figure_of_merit_m_s: float


@dataclass(frozen=True)
class Altitude:
    """Metres above the bottom."""

    t_ns: int
    arrival_ns: int
    source: str
    altitude_m: float


@dataclass(frozen=True)
class Lights:
    """Lamp level, 0 (off) to 1 (full)."""

    t_ns: int
    arrival_ns: int
    source: str
    level: float


@dataclass(frozen=True)
class Position:
    """A fix on the earth (WGS 84): GNSS at the surface, or an acoustic one of the vehicle below."""

    t_ns: int
    arrival_ns: int
    source: str
    latitude_deg: float
    longitude_deg: float
    sigma_m: float
    """1 sigma of each horizontal direction."""


@dataclass(frozen=True)
class UtcTime:
    """UTC as a device states it: the moment ``t_ns`` was ``utc_ns``."""

    t_ns: int
    arrival_ns: int
    source: str
    utc_ns: int
    """Nanoseconds since 1970-01-01 UTC."""


TelemetrySample: TypeAlias = (
    Depth
    | Attitude
    | AngularRate
    | Acceleration
    | Velocity
    | Altitude
    | Lights
    | Position
    | UtcTime
)

KINDS: dict[str, type[TelemetrySample]] = {
    "depth": Depth,
    "attitude": Attitude,
    "angular_rate": AngularRate,
    "acceleration": Acceleration,
    "velocity": Velocity,
    "altitude": Altitude,
    "lights": Lights,
    "position": Position,
    "utc_time": UtcTime,
}
"""Telemetry samples by the name that files, tables and reports call them."""
KIND_OF: dict[type[TelemetrySample], str] = {sample: kind for kind, sample in KINDS.items()}
"""The same the other way round."""
LENGTHS = {"wxyz": 4, "rate_rad_s": 3, "acceleration_m_s2": 3, "velocity_m_s": 3}
"""Fields that are arrays."""
STAMP = ("t_ns", "arrival_ns", "source")
"""The first fields of every sample."""
VALUES: dict[type[TelemetrySample], tuple[str, ...]] = {
    sample: tuple(field.name for field in fields(sample) if field.name not in STAMP)
    for sample in KIND_OF
}
"""The other fields, in their order."""


def values_of(sample: TelemetrySample) -> list[float]:
    """The numbers that a sample holds, in the order of its fields."""
    values: list[float] = []
    for name in VALUES[type(sample)]:
        value = getattr(sample, name)
        values += value if isinstance(value, tuple) else (value,)
    return values
