"""A small dive from pictures to dive folder, on a machine with the pretended device or without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from aquaflow.config import Config
from aquaflow.config.presets import merge
from aquaflow.dive.replay import map_recording
from aquaflow.dive.run import Finished
from aquaflow.lab.bench.ci_suite import dim_light
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.sources import open_recording
from tests.device.device_scenes import ALL_PARTS
from tests.device.gsplats_place import machine_with

FRAMES, DIMMED_AT = 11, 5
PICTURES = {
    "frames": FRAMES, "width": 80, "height": 60, "supersampling": 1, "camera_pitch_deg": 55.0,
}  # fmt: skip

FEW_STEPS: dict[str, Any] = {
    "optimiser": {
        "steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1, "refine_steps": 6,
        "heldout_steps": 3,
    },
}  # fmt: skip
SETTINGS: dict[str, Any] = {"threads": 1, "mapping": merge(ALL_PARTS, FEW_STEPS)}
"""Everything that a map can have, in few steps."""


def write_dimmed_dive(folder: Path) -> Path:
    """A synthetic dive whose light goes down half-way through: its views have exposures."""
    plain, dimmed = folder / "plain", folder / "dimmed"
    write_dive(plain, SyntheticConfig.model_validate(PICTURES))
    dim_light(plain, dimmed, DIMMED_AT, 0.65)
    return dimmed


def map_on(device: torch.device, recording: Path, dive: Path) -> Finished:
    """The recording as `aquaflow map` maps it on a machine with such a device."""
    config = Config.model_validate(SETTINGS)
    with machine_with(device):
        return map_recording(open_recording(recording), "small", dive, config)
