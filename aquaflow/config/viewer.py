"""Settings of the window into a dive."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.service import ListenConfig
from aquaflow.config.stage import Lab


class ViewerConfig(ListenConfig):
    """The live view in a browser (docs/viewer.md); off unless asked for."""

    enabled: bool = False
    port: int = Field(8231, ge=0, le=65535, description="0: any that is free")
    splats: int = Field(
        60_000, ge=100, description="Gaussians shown at most of a live map, which a browser gets "
        "again as often as it changes and the link allows: 14 to 18 bytes each",
    )  # fmt: skip
    refresh_s: Lab[float] = Field(3.0, gt=0, description="s between pictures of the whole map")
    pose_hz: Lab[float] = Field(4.0, gt=0, le=30, description="frustum and trajectory")
