"""One run of the benchmark as JSON: what the runner asks of a worker process."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from aquaflow.base.errors import AquaFlowError
from aquaflow.config import Config, parse_config
from aquaflow.config.presets import merge, preset
from aquaflow.lab.bench.scene import BenchmarkScene

RENDERERS = {"cpu": "cpu", "cuda": "gsplat"}
"""What draws on each device."""


@dataclass(frozen=True)
class BenchJob:
    """One contender on one scene."""

    scene: BenchmarkScene
    preset: str
    out: str
    """Dive folder to write."""
    peer: str | None = None
    """Another program in AquaFlow's place, on the frames that ``preset`` prepares."""
    overrides: dict[str, Any] | None = None
    """Of the config, on top of the preset."""
    repeat: int = 0
    device: str | None = None
    """cpu or cuda: map and learned prior run there or the run fails; None: as the preset says."""

    def config(self) -> Config:
        """The scene's settings, then the preset's, then this job's own."""
        wanted = merge(merge(Config().model_dump(), self.scene.overrides), preset(self.preset))
        steps = wanted["mapping"]["optimiser"]["refine_steps"]
        wanted["mapping"]["optimiser"]["refine_steps"] = round(self.scene.refine_share * steps)
        if self.device is not None:
            wanted["mapping"]["renderer"] = RENDERERS[self.device]
            wanted["prior"]["device"] = self.device
        return parse_config(merge(wanted, self.overrides or {}), f"benchmark of {self.scene.name}")

    def to_text(self) -> str:
        """The job as JSON, for the worker process."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_text(text: str) -> BenchJob:
        """The job that :meth:`to_text` wrote."""
        data = json.loads(text)
        return BenchJob(**{**data, "scene": BenchmarkScene(**data["scene"])})


# --------------------------------------------------------------------------------------------------
# How a process of a benchmark answers: a job comes in on stdin, its row goes out on stdout.

AnyJob = TypeVar("AnyJob")


def answer(from_text: Callable[[str], AnyJob], perform: Callable[[AnyJob], dict[str, Any]]) -> None:
    """Print the row of one job as JSON; of one that failed, the sentence that says why."""
    logging.captureWarnings(True)
    job = from_text(sys.stdin.read())
    try:
        row = perform(job)
    except AquaFlowError as error:
        row = {"failed": str(error)}
    print(json.dumps(row))
