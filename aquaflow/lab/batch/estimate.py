"""How much memory a dive will take: from its pictures' size, their number and the map's Gaussians.

Fitted to resident sets that were measured (docs/performance.md#memory), and on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

from aquaflow.config import Config
from aquaflow.lab.batch.run_job import MEGABYTE

BASE_MAP_MB = 325.0
"""`aquaflow map` before its first frame."""
BASE_TRACKING_MB = 161.0
"""The same with ``--tracking-only``, which loads no torch."""
VIEWS_BYTES_PER_PIXEL = 128 * 11.1
"""128 views in memory; one takes 0.85 MB at 320 x 240 px."""
KEYFRAMES_BYTES_PER_PIXEL = 32 * 33.9
"""32 keyframes in memory; one takes 0.65 MB at 160 x 120 px."""
BYTES_PER_GAUSSIAN = 2000.0
"""What is left of 470 to 580 MB, resident with 80,000 of them at 160 px."""
MB_PER_FRAME = 0.058
"""At the end of a dive all keyframes are adjusted: 0.48 MB each, at 120 in 1,000 frames."""
MARGIN = 1.35
"""Over the sum of the above: measured peaks are at most 1.32 of it (320 px, 20,000 Gaussians)."""
DEFAULT_WIDTH = 480
"""px that a recording is mapped at where nothing is asked."""
USUAL_ASPECT = 0.75
"""Height over width; wider pictures have fewer pixels."""
BYTES_PER_FRAME = 20_000
"""Of a recording whose frames are not counted: 1080p video at 4.8 Mbit/s, 30 frames/s. Pictures in
files take ten times as much, so that this errs to the safe side."""


@dataclass(frozen=True)
class Examined:
    """What is known of a recording before it is mapped."""

    frames: int | None = None
    width: int | None = None
    """px"""
    height: int | None = None
    """px"""


def memory_mb(seen: Examined, size_bytes: int, config: Config) -> int:
    """Estimate of a dive's peak, 1e6 bytes; ``size_bytes`` of the recording."""
    pixels = _pixels(seen, config)
    per_pixel, fixed_mb = KEYFRAMES_BYTES_PER_PIXEL, BASE_TRACKING_MB
    if config.mapping.enabled:
        per_pixel += VIEWS_BYTES_PER_PIXEL
        fixed_mb = BASE_MAP_MB + BYTES_PER_GAUSSIAN * config.mapping.max_gaussians / MEGABYTE
    frames = _frames(seen, size_bytes, config)
    return round(MARGIN * (fixed_mb + per_pixel * pixels / MEGABYTE + MB_PER_FRAME * frames))


def _pixels(seen: Examined, config: Config) -> float:
    """Of a mapped picture."""
    width = config.source.width or min(DEFAULT_WIDTH, seen.width or DEFAULT_WIDTH)
    if seen.width and seen.height:
        return width * width * seen.height / seen.width
    return width * width * USUAL_ASPECT


def _frames(seen: Examined, size_bytes: int, config: Config) -> int:
    """Frames that are mapped."""
    source = config.source
    there = seen.frames if seen.frames is not None else size_bytes // BYTES_PER_FRAME
    stop = there if source.stop is None else min(source.stop, there)
    return len(range(source.start, stop, source.every))
