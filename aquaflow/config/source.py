"""Settings of a source: which frames, and how they are prepared."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from aquaflow.config.stage import StageConfig


class SourceConfig(StageConfig):
    """Which frames, and how they are prepared."""

    every: int = Field(1, ge=1, description="use every n-th frame")
    start: int = Field(0, ge=0, description="first frame index")
    stop: int | None = Field(None, ge=1, description="first frame index not used")
    width: int | None = Field(
        None,
        ge=64,
        le=8192,
        description="px; frames are made this wide (None: 480, or less if smaller)",
    )
    crop: str | None = Field(None, description="left | right | x,y,width,height, before resizing")
    mask: Path | None = Field(
        None,
        description="picture of the camera's or the crop's size: white is used, black is not "
        "(vehicle frame, display)",
    )
    fps: float | None = Field(None, gt=0, description="frames/s of a folder without timestamps")
