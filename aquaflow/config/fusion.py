"""Settings of the fusion of telemetry with the camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from aquaflow.config.device import MountingConfig
from aquaflow.config.known_lengths import BoardConfig, LasersConfig
from aquaflow.config.stage import Lab, StageConfig


class FusionConfig(StageConfig):
    """How telemetry gives the map its metres, its gravity and its north."""

    enabled: bool = Field(True, description="False: telemetry is recorded and nothing else")
    camera: MountingConfig | None = Field(
        None,
        description="of the camera in the body, which looks forward without angles, down with "
        "pitch_deg -90; None: as the recording states it, else unknown",
    )
    mounting_sigma_deg: float = Field(
        3.0,
        gt=0,
        le=45,
        description="deg, 1 sigma of every stated mounting: set by eye (judgement)",
    )
    heading: bool = Field(
        True, description="trust the attitude's heading as a compass's; False: x of the world is "
        "the vehicle's first heading"
    )  # fmt: skip
    declination: Literal["auto", "none"] | Annotated[float, Field(ge=-180, le=180)] = Field(
        "auto", description="deg from true to magnetic north, east positive, that the vehicle has "
        "not added to its heading. auto: that of the World Magnetic Model at the first position, "
        "if the date is known; 0 if the compass's own device states positions, as ArduPilot adds "
        "the declination by itself once it has a position, and not without one (COMPASS_AUTODEC "
        "is 1 by default, COMPASS_DEC 0; AP_Compass.cpp, qgroundcontrol issue 143). none: unknown, "
        "north is magnetic. A vehicle that was given COMPASS_DEC, or its position by hand, needs 0"
    )  # fmt: skip
    heading_sigma_deg: float = Field(
        5.0, gt=0, le=90, description="deg, 1 sigma of the compass's constant error in a vehicle "
        "(judgement: ArduSub's calibrated compass beside thrusters and lamps)"
    )  # fmt: skip
    dvl_scale_sigma: float = Field(
        0.001, ge=0, le=0.1, description="relative, 1 sigma of a DVL's long-term accuracy: Water "
        "Linked A50 Performance 0.1 %, Standard 1 %; speed of sound for a wrong salinity adds 1 %"
    )  # fmt: skip
    position_lag_sigma_s: float = Field(
        0.3, ge=0, description="s, 1 sigma of how much older a position fix is than it states"
    )
    depth_change_sigma_m: Lab[float] = Field(
        0.2, gt=0, description="m, 1 sigma of the depth around its mean, taken as constant where "
        "positions are known and nothing measures down or depth: an AUV that follows even "
        "ground (judgement)"
    )  # fmt: skip
    every_keyframes: Lab[int] = Field(
        20, ge=1, description="keyframes after which telemetry straightens the keyframe graph"
    )
    boards: tuple[BoardConfig, ...] = Field(
        (), description="markers and boards of known size that may come into view"
    )
    lasers: LasersConfig | None = Field(None, description="two dots of known spacing, if mounted")
