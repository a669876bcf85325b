"""One survey in its own process, whose memory is that of this dive alone.

``python -m aquaflow.lab.bench.growth.worker`` reads a job on stdin; the last line of its
output is the row as JSON.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from aquaflow.base.profiler import Profiler
from aquaflow.base.stages import Stages
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.replay import fix_threads
from aquaflow.dive.run import DiveRun
from aquaflow.lab.bench.answer import answer
from aquaflow.lab.bench.growth.job import THREADS, GrowthJob
from aquaflow.lab.bench.growth.stages import TenthsMeter
from aquaflow.lab.bench.growth.stored import checkpoint_bytes, folder_bytes
from aquaflow.lab.bench.growth.viewer_start import viewer_start
from aquaflow.lab.bench.memory import peak_memory_mb, resident_mb
from aquaflow.lab.synthetic.survey import Survey
from aquaflow.slam import Slam


def perform(job: GrowthJob) -> dict[str, Any]:
    """Map the survey as `aquaflow map` maps a recording, and look at it meanwhile.

    Raises:
        AquaFlowError: the run failed; the sentence says why.
    """
    config, survey = job.config(), Survey(job.width)
    fix_threads(THREADS, config)
    start_mb = resident_mb()
    folder = DiveFolder(Path(job.out), config, overwrite=True)
    try:
        slam = Slam(config, Stages(Profiler(clock=time.thread_time)), folder.work)
        try:
            run = DiveRun("survey", folder, config, slam, survey.camera, survey.name_of)
            row = _dived(run, survey, job.frames) | _finished(run)
            folder.set_finished()
        finally:
            slam.close()
    finally:
        folder.close()
    row |= {"start_mb": start_mb, "peak_mb": peak_memory_mb()}
    row["finished_bytes"] = folder_bytes(folder.path)
    if config.mapping.enabled:
        row["viewer"] = viewer_start(folder.path)
    return row


def _dived(run: DiveRun, survey: Survey, frames: int) -> dict[str, Any]:
    """What there is when the last frame is in."""
    meter = TenthsMeter(run, frames)
    for frame in survey.frames(frames):
        run.frame(frame)
        meter.frame_done()
    path = run.folder.path
    return {
        "tenths": meter.tenths,
        "keyframes": len(run.slam.keyframes),
        "loops": run.slam.graph.loops,
        "dive_bytes": folder_bytes(path),
        "checkpoint_bytes": checkpoint_bytes(run.slam, path / "checkpoint.npz"),
        "end_mb": resident_mb(),
    }


def _finished(run: DiveRun) -> dict[str, Any]:
    """The end of the dive: the last adjustment, refining, evaluation and files."""
    began_s = time.process_time()
    metrics = run.finish([]).metrics
    return {
        "finish_cpu_s": round(time.process_time() - began_s, 3),
        **{key: metrics[key] for key in ("tracked", "lost", "gaussians", "psnr")},
    }


if __name__ == "__main__":
    answer(GrowthJob.from_text, perform)
