"""One survey in its own process, whose memory is that of this dive alone.

``python -m aquaflow.lab.bench.growth.worker`` reads a job on stdin; the last line of its
output is the row as JSON.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

from aquaflow.base.stages import Profiler, Stages
from aquaflow.base.storage.archive import write_facts_file
from aquaflow.base.storage.atomic import open_to_append
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.replay import fix_threads
from aquaflow.dive.run import DiveRun
from aquaflow.dive.views import open_finished
from aquaflow.geometry.arrays import Arrays, add_prefix, of_sim3
from aquaflow.lab.bench.growth.job import ABOARD, THREADS, GrowthJob
from aquaflow.lab.bench.job import answer
from aquaflow.lab.bench.memory import peak_memory_mb, resident_mb
from aquaflow.lab.evaluation.trajectory_error import absolute_error
from aquaflow.lab.synthetic.survey import FPS, SurveyPictures
from aquaflow.lab.synthetic.survey_plan import plan_of
from aquaflow.lab.synthetic.survey_telemetry import SurveyTelemetry
from aquaflow.mapping import state
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.image_metrics import psnr
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View
from aquaflow.slam import Slam


def perform(job: GrowthJob) -> dict[str, Any]:
    """Map the survey as `aquaflow map` maps a recording, and look at it meanwhile.

    Raises:
        AquaFlowError: the run failed; the sentence says why.
    """
    config = job.config()
    survey = SurveyPictures(job.width, plan=plan_of(job.scene, job.frames / FPS))
    fix_threads(THREADS, config)
    start_mb = resident_mb()
    folder = DiveFolder(Path(job.out), config, overwrite=True)
    try:
        slam = Slam(config, Stages(Profiler(clock=time.thread_time)), folder.work)
        try:
            run = DiveRun("survey", folder, config, slam, survey.camera, survey.name_of)
            row = _measure_dive(run, survey, job) | _finish_run(run)
            row |= {"psnr_in_the_end": mean_psnr(slam, job.frames), **path_errors(run, survey)}
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


def _measure_dive(run: DiveRun, survey: SurveyPictures, job: GrowthJob) -> dict[str, Any]:
    """What there is when the last frame is in."""
    telemetry = SurveyTelemetry(survey)
    if job.telemetry != "none":
        run.slam.metric.mounting = telemetry.mountings.stated
    samples = telemetry.samples(job.frames / FPS, ABOARD[job.telemetry])
    meter, waiting = TenthsMeter(run, survey, job.frames), next(samples, None)
    for frame in survey.frames(job.frames):
        while waiting is not None and waiting.arrival_ns <= frame.arrival_ns:
            run.sample(waiting)
            waiting = next(samples, None)
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
# How right the map is along the dive, and the path as a whole.


def path_errors(run: DiveRun, survey: SurveyPictures) -> dict[str, Any]:
    """RMS error of all positions over the length of the way, percent: ``ate_world_pct`` of the
    sub-maps as telemetry lays them into the world, in metres, ``ate_sub_maps_pct`` with each in a
    frame and unit of its own; None where there is none. And ``sub_maps``, their frames."""
    frames = run.slam.metric_frames()
    posed = [each for each in run.results if each.T_wc is not None]
    truth = np.array([survey.T_wc(each.frame.index).t for each in posed]).reshape(-1, 3)
    found = np.array([each.T_wc.t for each in posed if each.T_wc is not None]).reshape(-1, 3)
    of = np.array([each.sub_map for each in posed])
    length = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    squared, counts = 0.0, dict[str, int]()
    for number in np.unique(of).tolist():
        counts[str(number)] = int((of == number).sum())
        mine = of == number
        if counts[str(number)] > LEAST_ALIGNED:
            error = absolute_error(found[mine], truth[mine], length, with_scale=True)
            squared += counts[str(number)] * error.rmse**2
    aligned = sum(count for count in counts.values() if count > LEAST_ALIGNED)
    placed = {n: frame.T_nm for n, frame in frames.items() if frame.metric}
    world = np.array([number in placed for number in of.tolist()], dtype=bool)
    ate_world = None
    if world.sum() > LEAST_ALIGNED:
        pairs = zip(of[world].tolist(), found[world], strict=True)
        laid = np.array([placed[n].apply(p) for n, p in pairs])
        ate_world = absolute_error(laid, truth[world], length, with_scale=False).pct
    ate = 100.0 * math.sqrt(squared / aligned) / length if aligned else None
    return {
        "path_m": length,
        "sub_maps": counts,
        "ate_world_pct": ate_world,
        "ate_sub_maps_pct": ate,
    }


LEAST_ALIGNED = 10
"""Poses of a sub-map that say where it lies."""


def mean_psnr(slam: Slam, frames: int) -> list[float | None]:
    """dB in each tenth of the dive of views that were never mapped, from the map as it is."""
    rows: list[list[float]] = [[] for _ in range(TENTHS)]
    for number, views in slam.held_out.items():
        if number in slam.mappers and len(slam.mappers[number].gaussians):
            for view in views:
                tenth = min(view.frame_index * TENTHS // frames, TENTHS - 1)
                rows[tenth].append(psnr_of(slam.mappers[number], view))
    return [round(float(np.mean(row)), 2) if row else None for row in rows]


def psnr_of(mapper: Mapper, view: View) -> float:
    """dB of a view that was never mapped, where its pose is now."""
    mapper.take_light(view)
    shown = mapper.show(view).image.clamp(0.0, 1.0)
    return psnr(picture_out(shown), picture_out(view.target()))


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
LOOKS = 100
"""Times in a dive at which the newest held-out view is compared with the map."""


Tenth = dict[str, float | None]
"""``tracking_ms``, ``mapping_ms`` and ``graph_ms``, means over the frames of a tenth; at its end
``frames``, ``keyframes``, ``loops``, ``gaussians``, ``resident_mb`` (None where unknown),
``work_bytes``, ``psnr``, dB of views that were just held out, and the path's errors until then."""
TENTHS_FILE = "tenths.jsonl"
"""In the dive's folder: each tenth once it is over, as a dive of hours may not come to its end."""


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

    def __init__(self, run: DiveRun, survey: SurveyPictures, frames: int) -> None:
        self.tenths: list[Tenth] = []
        self._run, self._survey, self._frames = run, survey, frames
        self._done, self._last, self._before = 0, 0, _Spent.now(run)
        self._looks, self._psnr = 0, list[float]()

    def frame_done(self) -> None:
        """Count a frame."""
        self._done += 1
        if self._done * LOOKS >= (self._looks + 1) * self._frames:
            self._look()
        if self._done * TENTHS >= (len(self.tenths) + 1) * self._frames:
            self.tenths.append(self._tenth())
            with open_to_append(self._run.folder.path / TENTHS_FILE) as stream:
                stream.write(json.dumps(self.tenths[-1]).encode() + b"\n")

    def _look(self) -> None:
        """At the newest held-out view, from the map as it is by now."""
        self._looks += 1
        slam = self._run.slam
        number = slam.tracker.sub_map
        views = slam.held_out.get(number)
        if views and number in slam.mappers and len(slam.mappers[number].gaussians):
            self._psnr.append(psnr_of(slam.mappers[number], views[-1]))

    def _tenth(self) -> Tenth:
        seen, self._psnr = self._psnr, []
        spent, before, count = _Spent.now(self._run), self._before, self._done - self._last
        self._before, self._last = spent, self._done

        def mean_ms(stages: tuple[str, ...]) -> float:
            of = [spent.stages.get(name, 0.0) - before.stages.get(name, 0.0) for name in stages]
            return sum(of) / count

        elsewhere = (spent.process - before.process) - (spent.thread - before.thread)
        elsewhere = max(elsewhere, 0.0)  # two clocks are read one after the other
        slam, errors = self._run.slam, path_errors(self._run, self._survey)
        return {
            "frames": self._done,
            "tracking_ms": round(mean_ms(TRACKING), 3),
            "mapping_ms": round(mean_ms(MAPPING), 3),
            "graph_ms": round(mean_ms(GRAPH) + elsewhere / count, 3),
            "keyframes": len(slam.keyframes),
            "loops": slam.graph.loops,
            "gaussians": sum(mapper.count for mapper in slam.mappers.values()),
            "resident_mb": resident_mb(),
            "work_bytes": folder_bytes(self._run.folder.path),
            "psnr": round(float(np.mean(seen)), 2) if seen else None,
            "ate_world_pct": errors["ate_world_pct"],
            "ate_sub_maps_pct": errors["ate_sub_maps_pct"],
        }


if __name__ == "__main__":
    answer(GrowthJob.from_text, perform)
