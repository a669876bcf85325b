"""Settings of the coverage: what counts as seen, and how survey lines shall overlap."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.stage import Lab, StageConfig


class CoverageConfig(StageConfig):
    """What the camera has seen from above, and the lines that it was seen along."""

    enabled: bool = Field(True, description="False: neither shown nor written nor hinted at")
    cells: Lab[int] = Field(
        16, ge=4, le=64, description="cells of the plan along the shorter side of what a picture "
        "shows, median: 6 % of it, and 0.1 m at 2 m altitude",
    )  # fmt: skip
    least_views: Lab[int] = Field(
        3, ge=1, description="keyframes that see a place well, before it counts as seen well: two "
        "give a point, a third one contradicts a wrong match",
    )  # fmt: skip
    least_directions: Lab[int] = Field(
        2, ge=1, le=17, description="different directions among its views (from above, or from one "
        "of four sides in steps of 15 degrees): without parallax there is no range",
    )  # fmt: skip
    least_contrast: Lab[float] = Field(
        0.1, gt=0, lt=0.5, description="apparent contrast of the ground's texture below which it "
        "is too far for this water: three times the noise of a picture in dim light, 0.03 of its "
        "signal (judgement); the texture's own contrast is taken as 0.6",
    )  # fmt: skip
    overlap: float = Field(
        0.6, ge=0, le=0.95, description="wanted of neighbouring survey lines, share of the swath: "
        "photogrammetry asks for 60 % (judgement: currents and altitude need the margin)",
    )  # fmt: skip
    forward_overlap: float = Field(
        0.6, ge=0, le=0.95, description="wanted of one tracked picture with the next, share of "
        "what a picture shows along the path",
    )  # fmt: skip
