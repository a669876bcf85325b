"""One run in its own process: its peak memory can be measured, and its crash stops no other run.

``python -m aquaflow.lab.bench.worker`` reads a job on stdin; the last line of its output is
the row as JSON.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError, NotMappedError
from aquaflow.geometry.camera import load_camera
from aquaflow.lab.bench.job import BenchJob, answer
from aquaflow.lab.bench.memory import peak_memory_mb
from aquaflow.lab.bench.peers import run_peer
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.evaluation.naturalness import evaluate_naturalness
from aquaflow.lab.evaluation.protocol import evaluate_dive
from aquaflow.lab.evaluation.restoration import evaluate_restoration
from aquaflow.lab.evaluation.water_peers.contract import NAMES
from aquaflow.sources import open_recording


def perform(job: BenchJob) -> dict[str, Any]:
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
    return {**metrics, **measure_errors(scene, out), "peak_rss_mb": peak_mb}


# --------------------------------------------------------------------------------------------------
# The errors of one finished run: what ``aquaflow lab evaluate`` says, and the depth of its map.

TRUE_RANGE = "range"
"""A synthetic dive's folder of true ranges."""

ERRORS = (
    "ate_rmse_m_se3", "ate_rmse_m_sim3", "ate_pct_se3", "ate_pct_sim3", "rotation_rmse_deg",
    "rpe", "drift_pct", "medium_error",
)  # fmt: skip
"""Copied from the evaluation."""
COLOURS = ("hue_shift_deg", "chroma_difference", "lightness_ratio")
"""Of what is nearest in restored held-out views, copied from the naturalness."""
RESTORED = (
    "restored_psnr", "raw_psnr", *(f"restored_psnr_{name}" for name in NAMES),
    "restored_peer_reasons",
)  # fmt: skip
"""Of held-out views without water: ours, the camera's, those of published methods."""


def measure_errors(scene: BenchmarkScene, dive: Path) -> dict[str, Any]:
    """Every error that the scene's truth allows; null where it does not.

    Raises:
        InputError: the truth does not fit the run.
    """
    row: dict[str, Any] = dict.fromkeys((*ERRORS, "depth_absrel", *RESTORED))
    if scene.truth is not None:
        result = evaluate_dive(dive, Path(scene.truth)).to_json()
        row |= {key: result[key] for key in ERRORS}
        row["depth_absrel"] = depth_error(dive, Path(scene.truth), result["alignment"]["scale"])
    natural = evaluate_naturalness(dive)
    found_colours = {} if natural is None else natural.to_json()
    row |= {key: found_colours.get(key) for key in COLOURS}
    if scene.clean is not None and any((dive / "heldout").glob("*_restored.png")):
        try:
            found = evaluate_restoration(dive, Path(scene.clean), scene.clean_crop)
        except InputError:
            return row  # the clean recording lacks a held-out frame: nothing to compare with
        row |= {"restored_psnr": found.psnr_restored, "raw_psnr": found.psnr_raw}
        row |= {f"restored_psnr_{name}": found.psnr_peers.get(name) for name in NAMES}
        row["restored_peer_reasons"] = found.peer_reasons
    return row


def depth_error(dive: Path, truth: Path, metres_per_unit: float) -> float | None:
    """Mean of |range - true range| / true range over held-out pixels that the map covers.

    The map's unit is the trajectory's: its Sim(3) alignment, nothing that the depth may choose.
    """
    errors = []
    for file in sorted((dive / "heldout").glob("*_range.npz")):
        known = truth / TRUE_RANGE / file.name.replace("_range", "")
        if not known.is_file():
            continue
        z = np.load(file)["z"]
        with np.load(known) as stored:
            true, hit = _like(stored["range_m"], z.shape), _like(stored["hit"], z.shape)
        both = hit & (z > 0.0) & (true > 0.0)
        errors.append(np.abs(metres_per_unit * z[both] - true[both]) / true[both])
    if not errors or sum(map(len, errors)) == 0:
        return None
    return float(np.concatenate(errors).mean())


def _like(
    values: np.ndarray[Any, Any],  # [h, w]
    shape: tuple[int, ...],
) -> np.ndarray[Any, Any]:
    """The nearest of ``values`` [h, w] for every pixel of a picture of ``shape``."""
    rows = (np.arange(shape[0]) + 0.5) * values.shape[0] / shape[0]
    columns = (np.arange(shape[1]) + 0.5) * values.shape[1] / shape[1]
    return np.asarray(values[np.ix_(rows.astype(int), columns.astype(int))])


if __name__ == "__main__":
    answer(BenchJob.from_text, perform)
