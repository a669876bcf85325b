"""A survey of one length, which a process of its own maps."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from aquaflow.config import Config
from aquaflow.config.presets import load_configured
from aquaflow.lab.synthetic.streams import Instrument
from aquaflow.lab.synthetic.survey_plan import SurveyScene

Instruments = Literal["none", "attitude", "dvl"]
"""What is aboard beside the camera."""
ABOARD: dict[Instruments, tuple[Instrument, ...]] = {
    "none": (),
    "attitude": ("depth", "attitude"),
    "dvl": ("depth", "attitude", "velocity"),
}

THREADS = 1
"""CPU time is the work done then, whatever else the machine does; and what is spent outside of the
tracking thread is the keyframe graph's."""


@dataclass(frozen=True)
class GrowthJob:
    """What a process needs to know; all of it goes through its standard input."""

    frames: int
    width: int
    out: str
    """Dive folder."""
    preset: str
    tracking_only: bool = False
    scene: SurveyScene = "lines"
    telemetry: Instruments = "none"
    settings: str | None = None
    """Configuration file below the preset; None: the defaults."""

    def config(self) -> Config:
        """The preset, on one thread.

        Raises:
            InputError: the file of settings cannot be read.
            ConfigError: there is no such preset, or a setting is out of range.
        """
        path = None if self.settings is None else Path(self.settings)
        asked = {"threads": THREADS, "mapping": {"enabled": not self.tracking_only}}
        return load_configured(path, self.preset, asked, "benchmark of growth")

    def to_text(self) -> str:
        """The job as JSON, for the process."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_text(text: str) -> GrowthJob:
        """The job that :meth:`to_text` wrote."""
        return GrowthJob(**json.loads(text))
