"""Replay: every frame of a recording, in order, as fast as the machine goes, into a dive folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from aquaflow.base.errors import NotMappedError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.progress import WHOLE, Progress
from aquaflow.base.stages import Profiler, Stages
from aquaflow.base.worker import usable_threads
from aquaflow.config import Config, SourceConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.dive.calibration_pass import EarlyViews, found_in
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.preview import Preview
from aquaflow.dive.run import DiveRun, Finished
from aquaflow.mapping.work import MIN_VIEWS
from aquaflow.recordings.playback import Event, Playback, read_past_failures
from aquaflow.slam import Slam
from aquaflow.sources import GIVEN, RecordedCamera, mounting_of, notes_with, sources_of
from aquaflow.sources.telemetry_input import TelemetryInput
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.time_offset import (
    NotSynchronisedError,
    TimeOffset,
    offset_of_log,
    synchronise_samples,
)
from aquaflow.telemetry.turns import Array, Turns
from aquaflow.tracking.base import Base
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import CameraModel, Dropped, Frame

TORCH_PRIORS = ("xfeat", "aliked")
"""Kinds of prior that run in torch; a dive without them and without a map does not load it."""


def map_recording(
    recording: RecordedCamera,
    name: str,
    out: Path,
    config: Config,
    calibration: CameraModel | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    trace: bool = False,
    telemetry: TelemetryInput | None = None,
    settle: Callable[[], None] = lambda: None,
    base: Base | None = None,
    path: Path | None = None,
    preview: Preview | None = None,
) -> Finished:
    """Map a recording into the dive folder ``out``; with ``trace`` it gets a ``trace.json`` too.
    ``path``: where the recording lies, for the dive to remember. ``preview``: shows the dive while
    it is mapped.

    ``settle`` is called at the end of each stage: a benchmark lets it wait for a GPU.

    Logs of ``telemetry`` that are on a clock of their own are used from the last frame on, when
    the poses have shown their offset. In ``base``, an earlier dive, this one is looked for, and is
    in its frame once it was recognised there.

    Raises:
        InputError: the folder cannot be written, or ``base`` was described by another prior.
        ConfigError: crop or calibration do not fit the pictures.
        NotMappedError: the frames were read but gave no map; the folder says why.
    """
    fix_threads(usable_threads(config.threads), config)
    folder, failures = DiveFolder(out, config, overwrite), Failures()
    given = telemetry or TelemetryInput()
    try:
        slam = Slam(config, Stages(Profiler(trace, settle), failures), folder.work)
        calibration = calibration or recording.camera
        run = DiveRun(name, folder, config, slam, calibration, recording.name_of, trace)
        run.recording = path
        try:
            if base is not None:
                slam.localise_in(base)
            if slam.metric.mounting is None:
                with failures.contain("camera mounting"):
                    slam.metric.mounting = mounting_of(recording)
            playback = Playback(recording, given.synchronised, failures=failures)
            shown = progress or (lambda stage, done, total: None)
            if preview is not None:
                shown = preview.begin(run, shown)
            if calibration is None:
                _find_camera(run, recording, shown)
            else:
                run.early_views = EarlyViews(slam)
            finished = _replay(run, recording, given, playback, config, shown, preview)
            folder.set_finished()
            return finished
        finally:
            with failures.contain("closing"):
                slam.close()
    finally:
        for close in (folder.close, recording.close, given.close):
            with failures.contain("closing"):
                close()


def _find_camera(run: DiveRun, recording: RecordedCamera, progress: Progress) -> None:
    """Give the run the camera that the recording itself shows, if it shows one."""
    with run.slam.stages("self-calibration"):
        found = found_in(recording, run.config, lambda done, of: progress("calibrate", done, of))
        if found is not None:
            run.adopt(found)


def _replay(
    run: DiveRun, recording: RecordedCamera, telemetry: TelemetryInput, playback: Playback,
    config: Config, progress: Progress, preview: Preview | None,
) -> Finished:  # fmt: skip
    source, count, left = config.source, recording.frame_count, TimeLeft(run, progress)
    stop = count if source.stop is None else min(source.stop, count or source.stop)
    total = None if stop is None else len(range(source.start, stop, source.every))
    done = 0
    for event in _events(run, playback, source):
        if not isinstance(event, (Frame, Dropped)):
            run.sample(event)
            continue
        done += 1
        if isinstance(event, Dropped):
            run.drop(event)
        else:
            decided = run.frame(event)
            if preview is not None:
                preview.take(event, decided)
            if any(tracked.frame_class is FrameClass.KEYFRAME for tracked in decided):
                run.look()
        with run.slam.stages("progress"):
            progress("map", done, total)
            left.mapped(done, total)
    if done == 0:
        end = "the end" if source.stop is None else f"--stop {source.stop}"
        known = "" if count is None else f" of its {count} frames"
        raise NotMappedError(
            f"{run.name}: none{known} lies between --start {source.start} and {end}"
        )
    synchronise(run, telemetry)
    run.sources = _sources(run, recording)
    notes = notes_with(recording, run.calibration) + telemetry.notes

    def refined(done: int, total: int) -> None:
        progress("refine", done, total)
        left.refined()

    return run.finish(notes, refined)


REFINING_COST = 1.5
"""Of a refining step, in steps while frames come, of smaller maps; 1.2 to 2.5 in six dives."""
ENDING_STEPS = 250
"""Refining steps in whose time a dive is judged, measured and written; 110 to 380 in six dives."""


class TimeLeft:
    """Tells ``progress`` how long a replay takes in all, by its pace so far."""

    def __init__(self, run: DiveRun, progress: Progress) -> None:
        self._run, self._progress = run, progress
        self._begun_s = self._refining_s = time.monotonic()
        self._refined = 0

    def mapped(self, done: int, total: int | None) -> None:
        """``done`` of the frames are tracked and mapped."""
        steps = sum(mapper.steps for mapper in self._run.slam.mappers.values())
        if total is None or (self._run.config.mapping.enabled and not steps):
            return
        optimising_s = 1e-3 * self._run.profiler.totals_ms().get("optimise", 0.0)
        mapping_s = (time.monotonic() - self._begun_s) / done * (total - done)
        self._tell(mapping_s + self._ending_s(REFINING_COST * optimising_s / max(steps, 1)))

    def refined(self) -> None:
        """Another step of refining is done."""
        if self._refined == 0:
            self._refining_s = time.monotonic()
        else:
            step_s = (time.monotonic() - self._refining_s) / self._refined
            self._tell(self._ending_s(step_s))
        self._refined += 1

    def _ending_s(self, step_s: float) -> float:
        """What is left after the last frame, where a step of refining takes so long."""
        optimiser = self._run.config.mapping.optimiser
        maps = self._run.slam.mappers.values()
        steps = sum(each.refining_steps for each in maps if len(each.views) >= MIN_VIEWS)
        left_s = step_s * max(steps - self._refined, 0)
        if optimiser.refine_seconds is not None:
            left_s = min(left_s, max(optimiser.refine_seconds - step_s * self._refined, 0.0))
        return left_s + step_s * ENDING_STEPS

    def _tell(self, left_s: float) -> None:
        so_far_s = time.monotonic() - self._run.started
        self._progress(WHOLE, round(so_far_s), round(so_far_s + left_s))


def _sources(run: DiveRun, recording: RecordedCamera) -> dict[str, str]:
    """What was read, and where the camera is from."""
    stated = sources_of(recording)
    if run.calibration is None:
        assumed = "no calibration: a focal length was assumed and refined"
        stated["calibration"] = "; ".join([*filter(None, [stated.get("calibration")]), assumed])
    elif run.calibration is not recording.camera:
        stated["calibration"] = GIVEN
    return stated


def _events(run: DiveRun, playback: Playback, source: SourceConfig) -> Iterator[Event]:
    def read(start: int) -> Iterator[Event]:
        events = playback.events(source.every, start, source.stop)
        while True:
            with run.profiler.stage("read"):
                event = next(events, None)
            if event is None:
                return
            yield event

    def give_up(frame: int) -> None:
        run.notes.append(f"{run.name} could not be read after frame {frame}; the dive ends there")

    count, failures = playback.frame_count, run.slam.failures
    return read_past_failures(read, source.start, source, count, failures, give_up)


def fix_threads(threads: int, config: Config) -> None:
    """Results repeat bit for bit at a given number of threads, so it is set once and everywhere.

    torch and BLAS get one: their barriers cost whole scheduler quanta on a busy machine
    (notes/2026-11-speed.md#threads), and the heavy work runs in our own pool and in OpenCV's.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    if config.mapping.enabled or config.prior.kind in TORCH_PRIORS:
        import torch

        torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")  # small matrices: threads only wait for each other
    cv2.setNumThreads(threads)
    cv2.setRNGSeed(0)


# --------------------------------------------------------------------------------------------------
# Logs that were never synchronised with the video join the dive once its poses are known.


def synchronise(run: DiveRun, telemetry: TelemetryInput) -> dict[str, TimeOffset]:
    """Find the offset of every unsynchronised log and hand its samples to the dive; by file name.

    Called after the last frame and before the dive is finished. A log that cannot be used costs
    itself: a note says why.
    """
    found: dict[str, TimeOffset] = {}
    if not telemetry.unsynchronised:
        return found
    run.decide(run.slam.finish_tracking())
    camera, R_cb = turns_of(run.results), _body_to_camera(run.slam.metric.mounting)
    for name, log in telemetry.unsynchronised.items():
        with run.slam.failures.contain("telemetry"):
            samples = list(log.samples())
            try:
                offset = offset_of_log(name, samples, camera, R_cb)
            except NotSynchronisedError as error:
                run.notes.append(str(error))
                continue
            run.notes.append(in_words(name, offset))
            for sample in synchronise_samples(samples, offset):
                run.sample(sample)
            found[name] = offset
    return found


def turns_of(results: Sequence[Tracked]) -> Turns:
    """How the camera turned, within every sub-map."""
    posed = [each for each in results if each.T_wc is not None]
    return Turns.join(
        [
            _turns_of_sub_map([each for each in posed if each.sub_map == sub_map])
            for sub_map in sorted({each.sub_map for each in posed})
        ]
    )


def _turns_of_sub_map(posed: Sequence[Tracked]) -> Turns:
    in_order = sorted(posed, key=lambda each: each.frame.t_ns)
    t_s = np.array([each.frame.t_ns * 1e-9 for each in in_order])
    R_mc = np.stack([each.T_wc.R for each in in_order if each.T_wc is not None])
    return Turns.of_orientations(t_s, R_mc)


def _body_to_camera(mounting: MountingConfig | None) -> Array | None:
    return None if mounting is None else camera_in_body(mounting).R.T


def in_words(name: str, offset: TimeOffset) -> str:
    """One sentence for the user."""
    slow = f", its clock {1e6 * offset.drift:.0f} ppm slow" if offset.drift else ""
    begins_s = 1e-9 * offset.video_ns(0)
    return (
        f"{name} was synchronised by its rotations: it begins {begins_s:.3f} s after the first "
        f"picture (1 sigma {1e3 * offset.sigma_s:.0f} ms{slow}, correlation "
        f"{offset.correlation:.2f})"
    )
