"""Settings of the fusion of telemetry with the camera."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.known_lengths import BoardConfig, LasersConfig
from aquaflow.config.stage import Stage
from aquaflow.config.telemetry import MountingConfig


class FusionConfig(Stage):
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
    boards: tuple[BoardConfig, ...] = Field(
        (), description="markers and boards of known size that may come into view"
    )
    lasers: LasersConfig | None = Field(None, description="two dots of known spacing, if mounted")
