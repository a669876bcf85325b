"""One survey in its own process, whose memory is that of this dive alone.

``python -m aquaflow.lab.bench.growth.worker`` reads a job on stdin; the last line of its
output is the row as JSON.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

from aquaflow.base.stages import Profiler, Stages
from aquaflow.base.storage.archive import write_facts_file
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.replay import fix_threads
from aquaflow.dive.run import DiveRun
from aquaflow.dive.views import open_finished
from aquaflow.geometry.arrays import Arrays, add_prefix, of_sim3
from aquaflow.lab.bench.growth.job import THREADS, GrowthJob
from aquaflow.lab.bench.job import answer
from aquaflow.lab.bench.memory import peak_memory_mb, resident_mb
from aquaflow.lab.synthetic.survey import SurveyPictures
from aquaflow.mapping import state
from aquaflow.slam import Slam


def perform(job: GrowthJob) -> dict[str, Any]:
    """Map the survey as `aquaflow map` maps a recording, and look at it meanwhile.

    Raises:
        AquaFlowError: the run failed; the sentence says why.
    """
    config, survey = job.config(), SurveyPictures(job.width)
    fix_threads(THREADS, config)
    start_mb = resident_mb()
    folder = DiveFolder(Path(job.out), config, overwrite=True)
    try:
        slam = Slam(config, Stages(Profiler(clock=time.thread_time)), folder.work)
        try:
            run = DiveRun("survey", folder, config, slam, survey.camera, survey.name_of)
            row = _measure_dive(run, survey, job.frames) | _finish_run(run)
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


def _measure_dive(run: DiveRun, survey: SurveyPictures, frames: int) -> dict[str, Any]:
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


def _finish_run(run: DiveRun) -> dict[str, Any]:
    """The end of the dive: the last adjustment, refining, evaluation and files."""
    began_s = time.process_time()
    metrics = run.finish([]).metrics
    return {
        "finish_cpu_s": round(time.process_time() - began_s, 3),
        **{key: metrics[key] for key in ("tracked", "lost", "gaussians", "psnr")},
    }


# --------------------------------------------------------------------------------------------------
# How long a browser waits for a finished dive: from the command to the page and to the map.

PATIENCE_S = 60.0
"""After which a viewer that does not answer has failed."""


def viewer_start(dive: Path) -> dict[str, float]:
    """Open the finished ``dive`` as a browser does: seconds on the wall until the first request is
    answered with the page, ``page_s``, and until the map's Gaussians have come, ``map_s``.

    Raises:
        InputError: the dive lacks a file.
        OSError: the viewer does not answer.
    """
    began = time.perf_counter()
    page = open_finished(dive, ViewerConfig(port=0))
    try:
        _get(page.address)
        page_s = time.perf_counter() - began
        about = json.loads(_get(f"{page.address}scene.json"))["map"]
        for number in range(len(about["ends"])):
            _get(f"{page.address}map/{about['version']}/{number}")
        return {"page_s": round(page_s, 3), "map_s": round(time.perf_counter() - began, 3)}
    finally:
        page.close()


def _get(address: str) -> bytes:
    with urlopen(address, timeout=PATIENCE_S) as answer:
        return bytes(answer.read())


# --------------------------------------------------------------------------------------------------
# Bytes that a dive takes on the disk.


def folder_bytes(folder: Path) -> int:
    """Size of all files in ``folder`` and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def checkpoint_bytes(slam: Slam, scratch: Path) -> int:
    """Size of what a live dive's checkpoint would hold now; written to the file ``scratch``, which
    is removed again.

    Raises:
        InputError: it cannot be written.
    """
    facts, arrays = {}, _of_tracking(slam)
    for number, mapper in slam.mappers.items():
        facts[str(number)], parts = state.serialise(mapper, optimiser=True)
        arrays |= add_prefix(f"map{number}", parts)
    try:
        write_facts_file(scratch, facts, arrays)
        return scratch.stat().st_size
    finally:
        scratch.unlink(missing_ok=True)


def _of_tracking(slam: Slam) -> Arrays:
    keyframes = slam.keyframes.keyframes
    return {
        "frames": slam.frames.rows(),
        "keyframes": np.array([(k.frame_index, k.t_ns, k.sub_map, 0, 0) for k in keyframes]),
        "poses": of_sim3([keyframe.T_wc for keyframe in keyframes]),
        **add_prefix("graph", dict(slam.graph.graph.tables())),
    }


# --------------------------------------------------------------------------------------------------
# CPU time of the parts of a frame's way, in each tenth of a dive.

TRACKING = ("prepare", "overlay", "gate", "track", "record")
MAPPING = ("view", "insert", "optimise")
GRAPH = ("graph", "correct")
"""Stages of the profiler; the graph has all that other threads spend as well."""
TENTHS = 10
"""Parts of a dive that are looked at."""


Tenth = dict[str, float | None]
"""``tracking_ms``, ``mapping_ms`` and ``graph_ms``, means over the frames of a tenth; at its end
``frames``, ``keyframes``, ``gaussians`` and ``resident_mb`` (None where unknown)."""


@dataclass(frozen=True)
class _Spent:
    """Milliseconds of CPU time since the start."""

    process: float
    thread: float
    stages: Mapping[str, float]

    @staticmethod
    def now(run: DiveRun) -> _Spent:
        return _Spent(1e3 * time.process_time(), 1e3 * time.thread_time(), run.profiler.totals_ms())


class TenthsMeter:
    """Looks at a run after every tenth of its frames; its profiler has the thread's clock."""

    def __init__(self, run: DiveRun, frames: int) -> None:
        self.tenths: list[Tenth] = []
        self._run, self._frames = run, frames
        self._done, self._last, self._before = 0, 0, _Spent.now(run)

    def frame_done(self) -> None:
        """Count a frame."""
        self._done += 1
        if self._done * TENTHS >= (len(self.tenths) + 1) * self._frames:
            self.tenths.append(self._tenth())

    def _tenth(self) -> Tenth:
        spent, before, count = _Spent.now(self._run), self._before, self._done - self._last
        self._before, self._last = spent, self._done

        def mean_ms(stages: tuple[str, ...]) -> float:
            of = [spent.stages.get(name, 0.0) - before.stages.get(name, 0.0) for name in stages]
            return sum(of) / count

        elsewhere = (spent.process - before.process) - (spent.thread - before.thread)
        elsewhere = max(elsewhere, 0.0)  # two clocks are read one after the other
        slam = self._run.slam
        return {
            "frames": self._done,
            "tracking_ms": round(mean_ms(TRACKING), 3),
            "mapping_ms": round(mean_ms(MAPPING), 3),
            "graph_ms": round(mean_ms(GRAPH) + elsewhere / count, 3),
            "keyframes": len(slam.keyframes),
            "gaussians": sum(len(mapper.gaussians) for mapper in slam.mappers.values()),
            "resident_mb": resident_mb(),
        }


if __name__ == "__main__":
    answer(GrowthJob.from_text, perform)
