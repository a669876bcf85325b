"""Settings of a batch: how many dives at once, in how much memory, how often again."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from aquaflow.config.stage import StageConfig


class BatchConfig(StageConfig):
    """How a batch is run (docs/batch.md); nothing here changes a byte of a dive."""

    jobs: int | None = Field(
        None, ge=1, le=4096, description="dives at once; None: as cores and memory allow"
    )
    memory_gb: float | None = Field(
        None, gt=0, le=1e6, description="1e9 bytes for all dives at once; None: what is free"
    )
    retries: int = Field(
        2, ge=0, le=100, description="attempts after the first, for a dive whose process died"
    )
    cluster: str | None = Field(None, min_length=1, description="address of a Ray cluster")
    cache: Path | None = Field(
        None, description="local folder for what comes from and goes to an object store"
    )
