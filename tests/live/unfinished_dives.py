"""Dives with a checkpoint of nothing, for those that only look at when it was taken."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.geometry.arrays import of_camera
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.checkpoint.generations import FORMAT, state_file, write_state
from aquaflow.live.clock_reading import ClockReading
from aquaflow.tracking.frame_table import FRAME

H = 3_600_000_000_000
"""Nanoseconds of an hour."""
YESTERDAY = ClockReading(100 * H, 20_000 * 24 * H, "yesterday's boot")
"""When the last checkpoint was taken."""


def unfinished(
    dives: Path,
    name: str = "old",
    taken: ClockReading = YESTERDAY,
    state: DiveState = DiveState.OPEN,
) -> Path:
    """A dive with a checkpoint of nothing, and files that bear its time."""
    dive = dives / name
    dive.mkdir()
    camera = of_camera(guess_camera(64, 48))
    tracking = {"camera": camera, "source": {"width": None, "crop": None}}
    facts = {"format": FORMAT, "version": "0", "tracking": tracking, "clocks": {}}
    frames = {"tracking.frames": np.zeros(0, FRAME), "tracking.keyframes": np.zeros((0, 5))}
    write_state(dive, facts | {"moment": taken.to_json()}, frames)
    DiveStatus(state, False, None, taken.boot, None).write(dive)
    os.utime(state_file(dive), ns=(taken.wall_ns, taken.wall_ns))
    return dive
