"""``python -m aquaflow.lab.batch.job_process``: one job in a process of its own, that a recording
may crash without harm to others: one recording into one dive folder, or a function's call.

Reads a JSON object from stdin and prints one: the fields of an Outcome. What libraries print goes
to stderr.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from aquaflow.base.errors import AquaFlowError, is_full_disk, is_out_of_memory
from aquaflow.base.errors.crash_report import said_of

PR_SET_PDEATHSIG = 1
"""prctl(2): the signal that this process gets when its parent ends."""


def end_with(parent: int) -> None:
    """Let this process be killed when the process ``parent``, which started it, ends."""
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        sys.exit(1)


def outcome_of_failure(error: Exception) -> dict[str, Any]:
    """State and sentence for what mapping raised."""
    sentence, _ = said_of(error)
    if is_full_disk(error):
        state = "full"
    else:
        # What was short of memory beside other dives may have enough another time.
        again = is_out_of_memory(error) and not isinstance(error, AquaFlowError)
        state = "lost" if again else "failed"
    return {"state": state, "sentence": " ".join(sentence.split())}


def map_one(asked: dict[str, Any]) -> dict[str, Any]:
    """Map the recording that is asked for as `aquaflow map` does; fields of an Outcome."""
    from aquaflow.config import parse_config
    from aquaflow.geometry.camera import load_camera
    from aquaflow.sources import open_recording
    from aquaflow.sources.telemetry_input import open_telemetry

    settings = parse_config(asked["settings"], "batch")
    source = Path(asked["source"])
    calibration = None if asked["calibration"] is None else load_camera(Path(asked["calibration"]))
    recording = open_recording(source, fps=settings.source.fps)
    given = open_telemetry(source, fps=settings.source.fps)
    from aquaflow.dive.replay import map_recording  # loads torch

    finished = map_recording(
        recording, source.name, Path(asked["out"]), settings, calibration, telemetry=given,
        path=source,
    )  # fmt: skip
    metrics = finished.metrics
    return {
        "state": "poor" if finished.warnings else "done",
        "sentence": "; ".join(finished.warnings),
        "frames": metrics["frames"],
        "tracked": metrics["tracked"],
        "psnr": metrics["psnr"],
    }


def call(asked: dict[str, Any]) -> dict[str, Any]:
    """Call the function that is asked for; fields of an Outcome."""
    module, _, name = asked["function"].partition(":")
    getattr(import_module(module), name)(**asked["arguments"])
    return {"state": "done"}


def main() -> None:
    """Entry point of the process."""
    asked = json.load(sys.stdin)
    end_with(asked["parent"])
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    try:
        found = call(asked) if "function" in asked else map_one(asked)
    except Exception as error:
        found = outcome_of_failure(error)
    print(json.dumps(found), file=answer, flush=True)


if __name__ == "__main__":
    main()
