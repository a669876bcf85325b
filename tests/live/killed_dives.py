"""A live dive that is killed again and again: ``aquaflow run`` in a process of its own."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from aquaflow.dive.frames_csv import read_rows
from aquaflow.live.checkpoint.generations import read_state, state_file

CONFIG = """
lab: true
threads: 1
source: {fps: 10.0}
mapping:
  medium: {enabled: false}
  optimiser: {steps_keyframe: 2, steps_mapping: 2, steps_common: 1, refine_steps: 10}
service:
  checkpoint: {every_s: 1.0}
  hang_s: 600.0
  mapping: {steps_per_view: 2}
  health: {enabled: false, port: 8230}
"""
BEGUN_S = 120.0
"""Longest wait for a process to write its first checkpoint."""
LOOK_S = 0.05


@dataclass
class Killed:
    """What was found after each kill."""

    kills: int = 0
    lost_s: list[float] = field(default_factory=list)
    """From the last checkpoint to the kill."""
    known: list[int] = field(default_factory=list)
    """Frames that the checkpoint knew."""
    resumed: int = 0
    """Starts that said that they resumed."""


def kill_and_resume(
    source: Path, folder: Path, kills: int, longest_s: float, speed: float, seed: int = 0
) -> Killed:
    """Start, wait for a checkpoint and a random while, kill -9, look at what is left; at last let
    the dive come to its end."""
    rng, killed = random.Random(seed), Killed()
    dive, config = folder / "dive", folder / "vehicle.yaml"
    config.write_text(CONFIG)
    script = str(Path(sys.executable).with_name("aquaflow"))
    command = [script, "run", "--config", str(config), "--source", str(source)]
    command += ["--out", str(dive), "--speed", str(speed)]
    for _ in range(kills):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            if not _wrote(dive, process):
                break  # the recording came to its end
            time.sleep(rng.uniform(0.0, longest_s))
        finally:
            process.kill()
            process.wait()
        killed.kills += 1
        _examine(dive, killed)
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    log = [json.loads(line) for line in (dive / "log.jsonl").read_text().splitlines()]
    killed.resumed = sum("resumed" in entry["message"] for entry in log)
    return killed


def _wrote(dive: Path, process: subprocess.Popen[bytes]) -> bool:
    """Wait for a checkpoint that is newer than the process."""
    began, file = time.time(), state_file(dive)
    while not (file.is_file() and file.stat().st_mtime > began):
        if process.poll() is not None:
            return False
        assert time.time() - began < BEGUN_S, "no checkpoint was written"
        time.sleep(LOOK_S)
    return True


def _examine(dive: Path, killed: Killed) -> None:
    """Everything that is on the disk can be read."""
    checkpoint = read_state(state_file(dive))
    killed.known.append(len(checkpoint.frames))
    killed.lost_s.append(time.time() - checkpoint.moment.wall_ns * 1e-9)
    assert read_rows(dive / "frames.csv")


if __name__ == "__main__":  # killed_dives.py RECORDING FOLDER KILLS: the figures
    found = kill_and_resume(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), 4.0, 1.0)
    print(found)
