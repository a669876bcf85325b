"""One run into a dive folder, live or replayed: each frame's result, and the dive's."""

from __future__ import annotations

import logging
import time
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.base.clocks.deadline import FinishTime
from aquaflow.base.errors import InputError, NotMappedError, printable, times
from aquaflow.base.stages import pace
from aquaflow.config import Config
from aquaflow.config.mapping import InsertionConfig, OptimiserConfig
from aquaflow.config.stage import StageConfig
from aquaflow.dive import calibration_pass
from aquaflow.dive.calibration_pass import EarlyViews, FoundCamera, from_keyframes, in_words
from aquaflow.dive.deliverables import DeliverablePhase, Deliverables, deliverables_of
from aquaflow.dive.fixes_csv import fix_numbers
from aquaflow.dive.folder import SUGGESTED, TRACE, DiveFolder
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.metric_outputs import (
    MetricOutputs,
    Navigation,
    frame_numbers,
    sub_maps_in_words,
    utc_numbers,
)
from aquaflow.dive.placement import in_site_notes, in_site_numbers
from aquaflow.dive.results import metrics
from aquaflow.mapping.work import MIN_VIEWS, Progress
from aquaflow.recordings.kept_pictures import KeptPictures, PictureThread
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY
from aquaflow.recordings.telemetry_lines import TelemetryWriter
from aquaflow.slam import Slam
from aquaflow.sources.picture_check import PictureCheck
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.calibration_check import LensError, lens_error
from aquaflow.tracking.consistency import scale_drift
from aquaflow.tracking.frames import Tracked
from aquaflow.types import CameraModel, Dropped, Frame, TelemetrySample

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper

log = logging.getLogger(__name__)


FEW_FRAMES = 10
"""A second of a dive: a map begins once the picture has moved by 4 % of its width."""

UNCHECKED = (
    "whether the calibration fits could not be checked: too few keyframes see the same places "
    "while the camera turns"
)
"""As in a short live dive, which has fewer keyframes than a replay of the same pictures."""


@dataclass(frozen=True)
class Finished:
    """A finished run."""

    dive: Path
    metrics: dict[str, Any]
    notes: list[str]
    warnings: list[str]
    """Why the result is poor, and the remedy; empty for a good one."""


class DiveRun:
    """Passes frames through ``slam`` into ``folder``; ``finish`` writes the results."""

    def __init__(
        self,
        name: str,
        folder: DiveFolder,
        config: Config,
        slam: Slam,
        calibration: CameraModel | None,
        name_of: Callable[[int], str],
        trace: bool = False,
    ) -> None:
        """``name_of`` a frame's index: its file, or where it is in the film."""
        self.name, self.folder, self.slam = printable(name), folder, slam
        self.calibration = calibration
        self.preparation = Preparation(config.source, calibration)
        self.profiler = slam.profiler
        self.dropped: list[Dropped] = []
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.config = config
        self.lens_error: LensError | None = None
        """Result of the calibration check, if a calibration was given; known at the end."""
        self.early_views: EarlyViews | None = None
        """Of a replay with a calibration."""
        self.found: FoundCamera | None = None
        """The camera of a dive without calibration, as far as its own pictures show it."""
        self.sources: dict[str, str] = {}
        """A sentence on each of what was read of a recording: times, calibration, white."""
        self.recording: Path | None = None
        """What is mapped, for who wants its pictures again; None where that is no file."""
        self.live: dict[str, Any] | None = None
        """Counters of a live run for metrics.json."""
        self.telemetry_log: TelemetryWriter | None = None
        """Of a live run: a replay's telemetry is in files already."""
        self.deliverables = deliverables_of(slam)
        """By name: what is made of the dive beside the files of the core."""
        self.pictures: KeptPictures | None = None
        if config.pictures.enabled:
            self.pictures = KeptPictures(folder.path, 1e6 * config.pictures.most_mb)
        self.picture_thread: PictureThread | None = None
        """Of a live run, which waits for no disk."""
        self.started = time.monotonic()
        self.frame_ms = array("d")
        """Of every frame that was read: preparing, tracking and mapping it."""
        self.first_pose_s: float | None = None
        """Seconds from the start of the run."""
        self._check = PictureCheck()
        """What the pictures show says why they could not be placed."""
        self._name_of, self._trace = name_of, trace
        self._cpu_before_s = time.process_time()

    def adopt(self, found: FoundCamera) -> None:
        """Use the camera that the recording itself showed; before the first frame."""
        self.found = found
        self.preparation = Preparation(self.config.source, found.camera)

    @property
    def results(self) -> list[Tracked]:
        """Finished frames with their current poses; computed on demand."""
        return self.slam.results()

    # --- while frames come --------------------------------------------------------------------

    def frame(self, frame: Frame) -> list[Tracked]:
        """Process a frame; the frames that it finished; a picture that cannot be prepared costs
        itself, not the dive."""
        begun = time.monotonic()
        prepared = self._prepare(frame)
        if prepared is None:
            return []
        self._keep(prepared)
        self._check.add(prepared.image)
        decided = self.slam.process(prepared)
        self.decide(decided)
        self._time_frame(begun, decided)
        return decided

    def sample(self, sample: TelemetrySample) -> None:
        """A sample of telemetry; it never costs a frame."""
        with self.slam.failures.contain("telemetry"):
            self.slam.metric.add(sample)

    def samples(self, samples: Sequence[TelemetrySample]) -> None:
        """Samples in the order of arrival; a live dive keeps them in its folder."""
        with self.profiler.stage("telemetry"):
            for sample in samples:
                self.sample(sample)
            if self.telemetry_log is not None and samples:
                with self.slam.failures.contain("keeping of telemetry"):
                    self.telemetry_log.add(samples)

    def _prepare(self, frame: Frame) -> Frame | None:
        """None for a picture that cannot be prepared, which is dropped."""
        reason = "preparation failed, see log.jsonl"
        with self.slam.stages("prepare", frame.index):
            try:
                return self.preparation(frame)
            except InputError as error:
                reason = str(error)
        self.drop(Dropped(frame.index, frame.t_ns, reason))
        return None

    def _keep(self, frame: Frame) -> None:
        if self.picture_thread is not None:
            self.picture_thread.offer(frame)
        elif self.pictures is not None:
            with self.slam.stages("keep"):
                self.pictures.offer(frame)

    def catch_up(self) -> list[Tracked]:
        """Compute the pose of an earlier frame that waits; called while no new frame is there."""
        decided = self.slam.catch_up()
        self.decide(decided)
        return decided

    def look(self) -> None:
        """Let the deliverables take in what is new; it never costs a frame."""
        for name, each in self.deliverables.items():
            with self.slam.failures.contain(name):
                each.look()

    def _time_frame(self, begun: float, decided: list[Tracked]) -> None:
        now = time.monotonic()
        self.frame_ms.append(1e3 * (now - begun))
        if self.first_pose_s is None and any(t.T_wc is not None for t in decided):
            self.first_pose_s = now - self.started

    def drop(self, frame: Dropped) -> None:
        """A frame that no consumer received."""
        self.dropped.append(frame)
        log.warning("frame %d left out: %s", frame.index, frame.reason)
        row = FrameRow(
            frame.index,
            self._name_of(frame.index),
            frame.t_ns * 1e-9,
            "dropped",
            reason=frame.reason,
        )
        self.folder.record([row])

    def decide(self, decided: list[Tracked]) -> None:
        """Finished frames."""
        with self.profiler.stage("record"):
            self.folder.record(self._row(tracked) for tracked in decided)
        if self.early_views is not None:
            self.early_views.take(decided)

    def _row(self, tracked: Tracked) -> FrameRow:
        posed = tracked.T_wc is not None
        return FrameRow(
            tracked.frame.index,
            self._name_of(tracked.frame.index),
            tracked.frame.t_ns * 1e-9,
            tracked.frame_class.value,
            tracked.sub_map if posed else None,
            tracked.keyframe,
            tracked.quality.inlier_share if posed else None,
            tracked.reason,
        )

    def close(self) -> None:
        """Close what the run itself has open; may be called again."""
        if self.picture_thread is not None:
            self.picture_thread.close()
        if self.telemetry_log is not None:
            self.telemetry_log.close()

    # --- the end ------------------------------------------------------------------------------

    def finish(
        self,
        notes: list[str],
        progress: Progress | None = None,
        limits: FinishTime | None = None,
    ) -> Finished:
        """Refine and write; ``notes`` of the source go to the user with the run's own. What is not
        needed for whole files stays within ``limits``.

        Raises:
            NotMappedError: too few frames could be placed; the folder says why.
            InputError: the disk was too full for all files; those with room were written.
        """
        limits, attempt = limits or FinishTime(), self.slam.failures.attempt
        self.decide(self.slam.finish(progress, limits))
        if self.calibration is None and self.found is None:
            self._find_camera()
        with self.profiler.stage("write"):
            results, outputs = self.results, self._metric_outputs()
            self._note_what_was_left_out(results, notes, outputs)
            sub_maps = {t.frame.index: t.sub_map for t in results if t.T_wc}
            attempt("writing frames.csv", partial(self.folder.write_frames, sub_maps))
        if sum(tracked.T_wc is not None for tracked in results) < MIN_VIEWS:
            raise NotMappedError(self._why_not(len(results)))
        return self._write(results, outputs, limits)

    def _metric_outputs(self) -> MetricOutputs:
        attempt, telemetry = self.slam.failures.attempt, self.slam.metric.telemetry
        frames = attempt("metric frames", self.slam.metric_frames)
        navigation = attempt("navigation", lambda: Navigation.of(telemetry))
        return MetricOutputs(frames or {}, navigation or Navigation())

    def _note_what_was_left_out(
        self, results: list[Tracked], notes: list[str], outputs: MetricOutputs
    ) -> None:
        self.notes += notes
        if outputs.navigation.clock is not None:
            self.notes += outputs.navigation.clock.notes
        lost = sum(tracked.T_wc is None for tracked in results)
        if lost:
            self.notes.append(f"{lost} of {len(results)} frames got no pose")
            self.notes += self._check.oddities()
        sub_maps = {tracked.sub_map for tracked in results if tracked.T_wc is not None}
        if len(sub_maps) > 1:
            self.notes.append(
                f"tracking was lost {times(len(sub_maps) - 1)}: the dive has "
                f"{sub_maps_in_words([outputs.frame(number) for number in sub_maps])}"
            )
        camera = self.slam.tracker.camera
        if self.calibration is None and camera is not None:
            self.notes.append(in_words(self.found, camera, SUGGESTED))
        overlay = self.slam.overlays.share
        if overlay > 0.0:
            self.notes.append(
                f"an overlay of {100.0 * overlay:.1f} % of the picture was found and masked"
            )
        if self.calibration is not None and self.calibration.port is not None:
            self.notes.append(calibration_pass.port_note(self.calibration, self.calibration.port))
        if self.telemetry_log is not None and self.telemetry_log.lost:
            self.notes.append(
                f"{self.telemetry_log.lost} samples of telemetry are not in {TELEMETRY}: the disk "
                "was full"
            )
        self.notes += resolution_notes(self.config.mapping.resolution_mm, self.slam.mappers)
        self.notes += self.slam.tracker.monitor.counts.notes()
        drift = scale_drift(self.slam.graph.snapshot, self.slam.keyframes.keyframes)
        self.notes += [] if drift is None else drift.notes()
        if self.slam.in_base is not None:
            taken_over = self.slam.maps.taken_over
            self.notes += in_site_notes(self.slam.in_base, self.slam.keyframes, taken_over)
        for note in self.notes:
            log.info(note)

    def _find_camera(self) -> None:
        """From the keyframes, for the next dive, where neither the user nor a first pass gave a
        camera for this one."""
        with self.slam.stages("self-calibration"):
            self.found = from_keyframes(self.slam.keyframes.readable)

    def _why_not(self, read: int) -> str:
        if read == 0:
            return f"{self.name}: no frame could be read, see {self.folder.path}/frames.csv"
        if read < MIN_VIEWS:
            frames = "frame" if read == 1 else "frames"
            return f"{self.name} has {read} usable {frames}; a map needs at least {MIN_VIEWS}"
        if odd := self._check.oddities():
            return f"{self.name}: none of {read} frames could be placed: {'; '.join(odd)}"
        few = f", for which {read} frames are few" if read < FEW_FRAMES else ""
        return (
            f"{self.name}: none of {read} frames could be placed"
            f"{_most_common_reason(self.folder.rows, 'them')}; the pictures need texture and the "
            f"camera must move sideways{few}; see frames.csv for each frame"
        )

    def _write(
        self, results: list[Tracked], outputs: MetricOutputs, limits: FinishTime
    ) -> Finished:
        before = self.folder.deliverables()
        made = Deliverables(
            self.name, self.folder, self.slam, results, self.calibration, outputs, self.found,
            self.deliverables,
        )  # fmt: skip
        with self.profiler.stage("evaluate"):
            made.summarise()
        with self.profiler.stage("write"):
            made.write()
            made.make(DeliverablePhase.WRITE)
        with self.profiler.stage("evaluate"):
            made.evaluate(limits.evaluating)
        with self.profiler.stage("measure"):
            made.make(DeliverablePhase.MEASURE, limits.evaluating)
            self._add_notes(made.notes)
        with self.profiler.stage("write"):
            made.write_evaluation()
        self.check_calibration()
        if self.calibration is not None and not calibration_pass.can_tell(self.lens_error):
            self._add_notes([UNCHECKED])
        with self.profiler.stage("report"):
            self.warnings = self._shortcomings()
            made.make(DeliverablePhase.REPORT, limits.whole, self._numbers(results, made))
        self.warnings = self._shortcomings()  # the report's own included, as its time is
        numbers = self._numbers(results, made)
        attempt, write = self.slam.failures.attempt, self.folder.write_json
        attempt("writing metrics.json", partial(write, "metrics.json", numbers))
        if self._trace:
            attempt(f"writing {TRACE}", lambda: write(TRACE, self.profiler.chrome_trace()))
        self._settle(before)
        notes = self.notes + self.slam.failures.notes()
        return Finished(self.folder.path, numbers, notes, self.warnings)

    def _add_notes(self, notes: list[str]) -> None:
        """For the user; the log has them too, as it has those of the frames."""
        self.notes += notes
        for note in notes:
            log.info(note)

    def _settle(self, before: dict[Path, int]) -> None:
        """The files of the dive are of one moment: what was there ``before`` and was not written
        anew, for want of room or because it failed, is set aside.

        Raises:
            InputError: some did not.
        """
        with self.slam.failures.contain("setting files aside", full_disk=True):
            self.folder.set_aside(before)
        if self.slam.failures.disk_was_full:
            dive = self.folder.path
            again = "map again" if self.live is None else f"run `aquaflow run finish {dive}`"
            raise InputError(
                f"the disk is full: {dive} lacks some of its files, log.jsonl says which; make "
                f"room and {again}"
            )

    def check_calibration(self) -> None:
        """Ask the keyframes whether the calibration that was given fits them; a live dive also does
        so while it goes on."""
        if self.calibration is None:
            return
        with self.slam.stages("calibration check"):
            self.lens_error = lens_error(self.slam.keyframes.readable)
            if self.lens_error is None and self.early_views is not None:
                early = self.early_views.lens_error()
                self.lens_error = early if calibration_pass.can_tell(early) else None

    def _shortcomings(self) -> list[str]:
        gaussians = sum(len(mapper.gaussians) for mapper in self.slam.mappers.values())
        found = shortcomings(self.config, self.folder.rows, gaussians)
        return found + self.calibration_warnings + self.slam.failures.defects()

    @property
    def calibration_warnings(self) -> list[str]:
        """A sentence where the calibration does not fit, as far as it was checked; else none."""
        error = self.lens_error
        if self.calibration is None or error is None or not error.wrong:
            return []
        return [calibration_pass.warning(error, self.calibration)]

    @property
    def calibration_numbers(self) -> dict[str, Any] | None:
        """What the check found; None before it, without a calibration, and where it cannot tell."""
        if self.calibration is None or self.lens_error is None:
            return None
        return calibration_pass.to_json(self.lens_error, self.calibration)

    def _numbers(self, results: list[Tracked], made: Deliverables) -> dict[str, Any]:
        wall_s = time.monotonic() - self.started
        numbers = metrics(self.slam, results, self.dropped, made.held_out, wall_s)
        numbers |= frame_numbers(made.metric_frame) | utc_numbers(made.outputs.navigation)
        numbers["fixes"] = fix_numbers(made.outputs.frames)
        numbers["warnings"], numbers["failures"] = self.warnings, self.slam.failures.to_json()
        numbers["calibration_check"] = self.calibration_numbers
        numbers["self_calibration"] = None if self.found is None else self.found.to_json()
        in_base = self.slam.in_base
        taken_over = self.slam.maps.taken_over
        numbers["in_site"] = None if in_base is None else in_site_numbers(in_base, taken_over)
        numbers["sources"] = self.sources
        numbers["recording"] = None if self.recording is None else str(self.recording.absolute())
        numbers["cpu_s"] = round(time.process_time() - self._cpu_before_s, 3)  # of all threads
        if self.live is not None:
            numbers["live"] = self.live
        numbers |= pace(self.frame_ms, len(self.frame_ms), self.first_pose_s, wall_s)
        return numbers | {"notes": self.notes + self.slam.failures.notes()}


# --------------------------------------------------------------------------------------------------
# Shortcomings of a finished dive as sentences with remedies; printed before the results.

LEAST_POSED_SHARE = 0.5
"""Of all frames; a dive with fewer poses is not what its user asked for."""


def shortcomings(config: Config, rows: Sequence[FrameRow], gaussians: int) -> list[str]:
    """Sentences for a dive with the frames ``rows`` and a map of so many Gaussians."""
    found = []
    posed = sum(row.sub_map is not None for row in rows)
    if posed < LEAST_POSED_SHARE * len(rows):
        found.append(
            f"only {posed} of {len(rows)} frames have a pose"
            f"{_most_common_reason(rows, 'the others')}; take frames closer together (a smaller "
            "--every), give a calibration (--calib), and see frames.csv for each frame"
        )
    if config.mapping.enabled and gaussians == 0:
        found.append(f"the map is empty: it ends with 0 Gaussians; {_what_to_do(config)}")
    return found


def resolution_notes(resolution_mm: float | None, mappers: Mapping[int, Mapper]) -> list[str]:
    """What ``mapping.resolution_mm`` did not limit, and why."""
    early = sum(mapper.unlimited for mapper in mappers.values())
    if resolution_mm is None or early == 0:
        return []
    asked = f"mapping.resolution_mm, {resolution_mm:g} mm,"
    if all(mapper.metres_per_unit is None for mapper in mappers.values()):
        return [
            f"{asked} had no effect: the map's scale never became known in metres; it takes "
            "telemetry, such as depth or speed"
        ]
    return [
        f"{asked} does not hold for the {early:,} Gaussians that were added before the map's scale "
        "was known in metres"
    ]


def _most_common_reason(rows: Sequence[FrameRow], of: str) -> str:
    """Why frames have no pose; of reasons that differ in a number alone, one stands for all."""
    reasons = [row.reason for row in rows if row.sub_map is None and row.reason]
    if not reasons:
        return ""
    kind, count = Counter(reason.partition(":")[0] for reason in reasons).most_common(1)[0]
    example = next(reason for reason in reasons if reason.partition(":")[0] == kind)
    return f" ({count} of {of}: {example})"


def _what_to_do(config: Config) -> str:
    changed = [
        *_list_changes("insertion", config.mapping.insertion, InsertionConfig()),
        *_list_changes("optimiser", config.mapping.optimiser, OptimiserConfig(), "prune_"),
    ]
    if changed:
        return f"{' and '.join(changed)}: set it back"
    return "the camera must move sideways, over texture, for depths to be known"


def _list_changes(name: str, asked: StageConfig, usual: StageConfig, prefix: str = "") -> list[str]:
    """Settings of a stage of the map that are not the default, those called ``prefix``..."""
    return [
        f"mapping.{name}.{key} is {getattr(asked, key)}, by default {getattr(usual, key)}"
        for key in type(usual).model_fields
        if key.startswith(prefix) and getattr(asked, key) != getattr(usual, key)
    ]
