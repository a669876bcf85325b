"""Settings of the small pictures that a dive keeps of what its camera saw."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.stage import StageConfig


class PicturesConfig(StageConfig):
    """One a second, for the viewer; fewer of a long dive."""

    enabled: bool = Field(True, description="False: none are kept")
    most_mb: float = Field(
        64.0, gt=0, description="MB (1e6 bytes) of all pictures of a dive: where they take more, "
        "every second one is removed, and from then on half as many are kept",
    )  # fmt: skip
