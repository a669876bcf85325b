"""Settings of the recorder: how pictures are kept, and how files are cut."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from aquaflow.config.stage import Lab, StageConfig


class RecordingConfig(StageConfig):
    """How pictures are kept, how files are cut, and when to stop."""

    keep_received: bool = Field(
        True, description="keep JPEG, PNG, WebP and H.264 as the camera delivered them"
    )
    picture: Literal["jpeg", "png", "raw"] = Field(
        "jpeg",
        description="for pictures that came without such bytes; png and raw lose nothing "
        "(measured at 640x480 on one core: jpeg 1 ms, png 10 ms, raw 28 MB/s at 30 pictures/s)",
    )
    jpeg_quality: int = Field(
        95, ge=1, le=100, description="OpenCV's default; 8x8 blocks would be mapped as texture"
    )
    flush_s: Lab[float] = Field(
        0.5, gt=0, le=1, description="every so often all is brought to the disk (fsync)"
    )
    chunk_kb: Lab[int] = Field(
        512, ge=16, le=16_384, description="kB; a damaged place costs one chunk"
    )
    file_s: float = Field(600.0, gt=0, description="a new file after this long")
    file_mb: int = Field(2000, ge=1, description="MB; a new file after this much: FAT32 holds 4 GB")
    reserve_mb: int = Field(
        1000, ge=0, description="MB; recording stops while so much of the disk is still free"
    )
    queue_mb: Lab[int] = Field(
        128, ge=1, description="MB waiting for a slow disk: 4 s of 720p pictures; more is dropped"
    )
