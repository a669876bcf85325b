"""One run in its own process: its peak memory can be measured, and its crash stops no other run.

``python -m aquaflow.lab.bench.worker`` reads a job on stdin; the last line of its output is
the row as JSON.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aquaflow.base.errors import NotMappedError
from aquaflow.geometry.camera import load_camera
from aquaflow.lab.bench.answer import answer
from aquaflow.lab.bench.job import Job
from aquaflow.lab.bench.measure import measured
from aquaflow.lab.bench.memory import peak_memory_mb
from aquaflow.lab.bench.peers import run_peer
from aquaflow.sources import open_recording


def perform(job: Job) -> dict[str, Any]:
    """Run the job and measure what it wrote; a map that ends with 0 Gaussians has failed.

    No run hears telemetry, also where the recording has it: the table compares monocular methods,
    and the peers have pictures alone. Trajectories are compared after a Sim(3) alignment.

    Raises:
        AquaFlowError: the run failed; the sentence says why.
    """
    scene, out = job.scene, Path(job.out)
    if job.peer is not None:
        metrics = run_peer(job.peer, scene, job.config(), out)
    else:
        import torch  # two seconds that no peer needs

        from aquaflow.dive.replay import map_recording
        from aquaflow.lab.bench.meter import meter_of

        meter = meter_of(torch.device(job.device or "cpu"))
        calibration = None if scene.calibration is None else load_camera(Path(scene.calibration))
        recording = open_recording(Path(scene.recording), fps=job.config().source.fps)
        metrics = map_recording(
            recording, scene.name, out, job.config(), calibration, True, settle=meter.settle
        ).metrics
        metrics["gpu_mb"] = meter.peak_mb()
        if job.device == "cuda" and metrics["device"] == "cpu":
            raise NotMappedError(f"{scene.name}: the GPU failed, and the map went on on the CPU")
        if job.config().mapping.enabled and metrics["gaussians"] == 0:
            raise NotMappedError(f"{scene.name}: {'; '.join(metrics['warnings'])}")
    peak_mb = peak_memory_mb()  # before the evaluation, whose memory is not the run's
    return {**metrics, **measured(scene, out), "peak_rss_mb": peak_mb}


if __name__ == "__main__":
    answer(Job.from_text, perform)
