"""Replay: every frame of a recording, in order, as fast as the machine goes, into a dive folder."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from aquaflow.config import Config
from aquaflow.dive import TRACE, DiveFolder, FrameRow
from aquaflow.errors import InputError, NotMappedError
from aquaflow.messages import CameraModel, Dropped, Frame
from aquaflow.outcome import (
    HeldOut,
    examine_held_out,
    largest_sub_map,
    metrics,
    refined_poses,
    summarise_water,
)
from aquaflow.preparation import Preparation
from aquaflow.profiler import Profiler, pace
from aquaflow.reporting import report_data
from aquaflow.slam import MIN_VIEWS, Slam
from aquaflow.sources import RecordedCamera
from aquaflow.tracking.frames import Tracked

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int | None], None]
"""Called with the stage, the steps done and, where known, the steps there are."""


@dataclass(frozen=True)
class Replayed:
    """A finished run."""

    dive: Path
    metrics: dict[str, Any]
    notes: list[str]


def map_recording(
    recording: RecordedCamera,
    name: str,
    out: Path,
    config: Config,
    calibration: CameraModel | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    trace: bool = False,
) -> Replayed:
    """Map a recording into the dive folder ``out``; with ``trace`` it gets a ``trace.json`` too.

    Raises:
        InputError: the folder cannot be written.
        ConfigError: crop or calibration do not fit the pictures.
        NotMappedError: the frames were read but gave no map; the folder says why.
    """
    _fix_threads(config.threads or os.cpu_count() or 1)
    folder = DiveFolder(out, config, overwrite)
    try:
        replay = _Replay(recording, name, folder, config, calibration, progress, trace)
        try:
            return replay.run()
        finally:
            replay.slam.close()
    finally:
        folder.close()
        recording.close()


class _Replay:
    """One run's state; ``run`` is its table of contents."""

    def __init__(
        self,
        recording: RecordedCamera,
        name: str,
        folder: DiveFolder,
        config: Config,
        calibration: CameraModel | None,
        progress: Progress | None,
        trace: bool,
    ) -> None:
        self.recording, self.name, self.folder, self.config = recording, name, folder, config
        self.calibration = calibration or recording.camera
        self.preparation = Preparation(config.source, self.calibration)
        self.profiler = Profiler(trace)
        self.slam = Slam(config, self.profiler, folder.work)
        self._trace = trace
        self._cpu_before_s = time.process_time()
        self.results: list[Tracked] = []
        self.dropped: list[Dropped] = []
        self.notes: list[str] = []
        self.frame_ms: list[float] = []
        """Of every frame that was read: preparing, tracking and mapping it."""
        self.first_pose_s: float | None = None
        """Seconds from the start of the run."""
        self._progress = progress or (lambda stage, done, total: None)

    def run(self) -> Replayed:
        started = time.monotonic()
        self._frames(started)
        self._decide(self.slam.finish(lambda done, total: self._progress("refine", done, total)))
        with self.profiler.stage("write"):
            self.results = self.slam.settled(self.results)
            self._note_what_was_left_out()
            self.folder.write_frames({t.frame.index: t.sub_map for t in self.results if t.T_wc})
        if sum(tracked.T_wc is not None for tracked in self.results) < MIN_VIEWS:
            raise NotMappedError(self._why_not())
        return self._write(started)

    # --- frames -------------------------------------------------------------------------------

    def _frames(self, started: float) -> None:
        source = self.config.source
        count = self.recording.frame_count
        stop = count if source.stop is None else min(source.stop, count or source.stop)
        total = None if stop is None else len(range(source.start, stop, source.every))
        done = 0
        profile = self.profiler.stage
        frames = self.recording.frames(source.every, source.start, source.stop)
        while True:
            with profile("read"):
                frame = next(frames, None)
            if frame is None:
                return
            done += 1
            if isinstance(frame, Dropped):
                self._drop(frame)
            else:
                self._frame(frame, started)
            with profile("progress"):
                self._progress("map", done, total)

    def _frame(self, frame: Frame, started: float) -> None:
        """One frame's way; a picture that cannot be prepared costs itself, not the dive."""
        begun = time.monotonic()
        try:
            with self.profiler.stage("prepare"):
                prepared = self.preparation(frame)
        except InputError as error:
            self._drop(Dropped(frame.index, frame.t_ns, str(error)))
            return
        self._decide(self.slam.process(prepared))
        self._time_frame(started, begun)

    def _time_frame(self, started: float, begun: float) -> None:
        now = time.monotonic()
        self.frame_ms.append(1e3 * (now - begun))
        if self.first_pose_s is None and any(t.T_wc is not None for t in self.results):
            self.first_pose_s = now - started

    def _drop(self, frame: Dropped) -> None:
        self.dropped.append(frame)
        log.warning("frame %d left out: %s", frame.index, frame.reason)
        row = FrameRow(
            frame.index,
            self.recording.name_of(frame.index),
            frame.t_ns * 1e-9,
            "dropped",
            reason=frame.reason,
        )
        self.folder.record([row])

    def _decide(self, decided: list[Tracked]) -> None:
        self.results += [tracked.bare() for tracked in decided]
        with self.profiler.stage("record"):
            self.folder.record(self._row(tracked) for tracked in decided)

    def _row(self, tracked: Tracked) -> FrameRow:
        posed = tracked.T_wc is not None
        return FrameRow(
            tracked.frame.index,
            self.recording.name_of(tracked.frame.index),
            tracked.frame.t_ns * 1e-9,
            tracked.frame_class.value,
            tracked.sub_map if posed else None,
            tracked.keyframe,
            tracked.quality.inlier_share if posed else None,
            tracked.reason,
        )

    # --- the end ------------------------------------------------------------------------------

    def _note_what_was_left_out(self) -> None:
        self.notes += self.recording.notes
        lost = sum(tracked.T_wc is None for tracked in self.results)
        if lost:
            self.notes.append(f"{lost} of {len(self.results)} frames got no pose")
        sub_maps = {tracked.sub_map for tracked in self.results if tracked.T_wc is not None}
        if len(sub_maps) > 1:
            self.notes.append(
                f"tracking was lost {len(sub_maps) - 1} times: the dive has {len(sub_maps)} "
                "sub-maps without a common scale"
            )
        if self.calibration is None and self.slam.tracker.camera is not None:
            focal, sigma = self.slam.tracker.camera.fx, self.slam.tracker.focal_sigma
            self.notes.append(
                "no calibration was given: the focal length was guessed and refined to "
                f"{focal:.0f} px ({100.0 * sigma:.0f} % formal uncertainty), distortion ignored"
            )
        for note in self.notes:
            log.info(note)

    def _why_not(self) -> str:
        read = len(self.results)
        if read == 0 and not self.dropped:
            source, count = self.config.source, self.recording.frame_count
            stop = "the end" if source.stop is None else f"--stop {source.stop}"
            known = "" if count is None else f" of its {count} frames"
            return f"{self.name}: none{known} lies between --start {source.start} and {stop}"
        if read == 0:
            return f"{self.name}: no frame could be read, see {self.folder.path}/frames.csv"
        if read < MIN_VIEWS:
            return f"{self.name} has {read} usable frames; a map needs at least {MIN_VIEWS}"
        return (
            f"{self.name}: none of {read} frames could be placed; the pictures need texture and "
            "the camera must move sideways, see frames.csv for each frame"
        )

    def _write(self, started: float) -> Replayed:
        main = largest_sub_map(self.results)
        with self.profiler.stage("evaluate"):
            held_out = examine_held_out(self.slam, main)
            waters = {n: summarise_water(mapper) for n, mapper in self.slam.mappers.items()}
            water = waters.get(main)
            poses = refined_poses(self.slam, self.results)
        times = {tracked.frame.index: tracked.frame.t_ns * 1e-9 for tracked in self.results}
        with self.profiler.stage("write"):
            self.folder.write_trajectory([times[i] for i in poses], list(poses.values()))
            assert self.slam.tracker.camera is not None
            self.folder.write_cameras(self.slam.tracker.camera, self.calibration)
            for sub_map, mapped in self.slam.mappers.items():
                suffix = "" if sub_map == main else f"_{sub_map}"
                self.folder.write_map(mapped, waters[sub_map], suffix)
            self.folder.write_held_out(held_out)
        with self.profiler.stage("report"):
            numbers = self._numbers(held_out, started)
            mapper = self.slam.mappers.get(main)
            evidence = None if mapper is None else mapper.scene.water_evidence
            self.folder.write_medium(water, numbers["scale_source"], evidence)
            self.folder.write_report(
                report_data(
                    self.name, self.slam, self.results, self.dropped, poses, held_out, water,
                    numbers, self.notes, calibrated=self.calibration is not None,
                )
            )  # fmt: skip
        numbers = self._numbers(held_out, started)  # the report's own time included
        self.folder.write_json("metrics.json", numbers)
        if self._trace:
            self.folder.write_json(TRACE, self.profiler.chrome_trace())
        return Replayed(self.folder.path, numbers, self.notes)

    def _numbers(self, held_out: list[HeldOut], started: float) -> dict[str, Any]:
        wall_s = time.monotonic() - started
        numbers = metrics(self.slam, self.results, self.dropped, held_out, wall_s)
        numbers["cpu_s"] = round(time.process_time() - self._cpu_before_s, 3)  # of all threads
        return numbers | pace(self.frame_ms, len(self.frame_ms), self.first_pose_s, wall_s)


def _fix_threads(threads: int) -> None:
    """Results repeat bit for bit at a given number of threads, so it is set once and everywhere.

    torch and BLAS get one: their barriers cost whole scheduler quanta on a busy machine
    (kernel_notes.md, pitfall 4), and the heavy work runs in our own pool and in OpenCV's.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")  # small matrices: threads only wait for each other
    cv2.setNumThreads(threads)
    cv2.setRNGSeed(0)
