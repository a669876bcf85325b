"""Runs every contender on every scene, interleaved, each in a process of its own.

A run that fails is a row with the reason: leaving it out would make the rest look better than it
is.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aquaflow.lab.bench import machine
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.evaluation.water_peers.contract import NAMES

WORKER = "aquaflow.lab.bench.worker"
"""A run has a process of its own, so that its peak memory is its own too."""

LIMIT_S = 3600.0
"""A run that takes longer is stopped, and marked as failed."""

KEYS = (
    "frames", "tracked", "lost", "skipped", "keyframes", "mapping_frames", "common_frames",
    "gaussians", "wall_s", "cpu_s", "fps", "stage_ms", "peak_rss_mb", "psnr", "ssim",
    "psnr_as_tracked", "ssim_as_tracked", "flip", "lpips", "lpips_alex", "lpips_reason",
    "heldout_frames",
    "ate_rmse_m_se3", "ate_rmse_m_sim3", "ate_pct_se3", "ate_pct_sim3",
    "rpe", "drift_pct", "depth_absrel", "medium_error", "hue_shift_deg",
    "chroma_difference", "lightness_ratio", "restored_psnr", "raw_psnr",
    *(f"restored_psnr_{name}" for name in NAMES), "restored_peer_reasons",
    "ms_per_frame", "time_to_first_pose_s", "features", "renderer", "device", "gpu_mb",
)  # fmt: skip
"""In every row; null where the run has no such thing."""

Row = dict[str, Any]
Perform = Callable[[BenchJob], Row]
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Contender:
    """What runs on every scene: AquaFlow with a preset, or a peer."""

    preset: str
    peer: str | None = None

    @property
    def name(self) -> str:
        """The peer's name, or the preset's."""
        return self.peer or self.preset


def jobs_for(
    scenes: Sequence[BenchmarkScene],
    contenders: Sequence[Contender],
    repeats: int,
    out: Path,
    device: str | None = None,
) -> list[BenchJob]:
    """All runs in the order of running.

    Repeats are the outermost loop and every scene sees its contenders in another order, so that a
    machine that gets slower meanwhile does so for all of them.
    """
    jobs = []
    for repeat in range(repeats):
        for position, scene in enumerate(scenes):
            turn = (position + repeat) % len(contenders)
            for contender in [*contenders[turn:], *contenders[:turn]]:
                name, peer = f"{_file_name(scene.name)}_{contender.name}_{repeat}", contender.peer
                folder = str(out / "dives" / name)
                jobs.append(BenchJob(scene, contender.preset, folder, peer, None, repeat, device))
    return jobs


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def run_all(
    jobs: Sequence[BenchJob], progress: Progress, perform: Perform | None = None
) -> list[Row]:
    """One row a job, in their order; never raises for a run that fails."""
    rows = []
    for done, job in enumerate(jobs, 1):
        rows.append(row_of(job, machine.load(), (perform or in_process)(job)))
        progress("runs", done, len(jobs))
    return rows


def row_of(job: BenchJob, load: float | None, result: Row) -> Row:
    """The stable keys of a row (docs/formats.md#json-output), then all else that it measured."""
    return {
        "scene": job.scene.name,
        "preset": None if job.peer else job.preset,
        "peer": job.peer,
        "repeat": job.repeat,
        "failed": result.get("failed"),
        "load": load,
        **dict.fromkeys(KEYS),
        **{key: value for key, value in result.items() if key != "failed"},
    }


def in_process(job: BenchJob) -> Row:
    """The worker's answer, or why there is none."""
    return answer_of(WORKER, job.to_text(), LIMIT_S)


def answer_of(worker: str, job: str, limit_s: float | None = None) -> Row:
    """What the module ``worker`` answers to ``job`` on its standard input: the JSON of its last
    line, or ``failed`` with the reason. None: it may take as long as it takes."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", worker],
            input=job,
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"stopped after {limit_s:.0f} s"}
    if done.returncode != 0:
        said = done.stderr.strip().splitlines()
        return {"failed": f"the run crashed ({done.returncode}): {said[-1] if said else 'silent'}"}
    answer: Row = json.loads(done.stdout.strip().splitlines()[-1])
    return answer
