"""AquaFlow, the algorithm: frames in, poses and maps out. No clocks decide a replay's results.

:class:`Slam` is one frame's way through tracking and mapping; below it stands what a frame gives to
the maps."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.base.clocks.deadline import Deadline, FinishTime
from aquaflow.base.errors import ConfigError
from aquaflow.base.stages import Stages
from aquaflow.base.worker import Worker
from aquaflow.config import Config, MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.mapping.work import Growth, Insertion, MapWork, NoMaps, OwnedMaps
from aquaflow.prior.contract import Prior
from aquaflow.prior.factory import make_prior
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.adjustment.adjuster import Adjuster
from aquaflow.tracking.base import Base, BaseLookup, InBase
from aquaflow.tracking.frame_table import FrameTable, RelativeFrame, RelativePoses
from aquaflow.tracking.frames import (
    FrameClass,
    KeyframeEdge,
    NewDepths,
    Revisit,
    Step,
    Tracked,
    without_pictures,
)
from aquaflow.tracking.gate import FrameGate, GateKind, GateVerdict
from aquaflow.tracking.graph.keyframe_graph import KeyframeGraph, LoopsFound
from aquaflow.tracking.initialisation.back_fill import BackFillResult
from aquaflow.tracking.keyframe_reuse import ReuseResult
from aquaflow.tracking.loops import Places
from aquaflow.tracking.metric.straightening import learned_scales
from aquaflow.tracking.metric.world_frames import WorldFrames
from aquaflow.tracking.overlay import OverlayFinder
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.render.contract import Renderer
    from aquaflow.render.views import View

SETTLING_ROUNDS = 2
"""Most optimisations with telemetry at the end: the second starts from a path that the first pulled
straight, whose metric frame is better."""


class Slam:
    """One dive: a tracker, its keyframes and their graph, and a map for every sub-map."""

    def __init__(
        self,
        config: Config,
        stages: Stages | None = None,
        work: Path | None = None,
        worker: Worker | None = None,
        maps: MapWork | None = None,
    ) -> None:
        """``stages`` time the dive; what one of them raises is counted, and costs that stage. What
        does not fit into memory waits in the folder ``work``, if there is one.

        Without a ``worker`` everything is done in step with the frames, and a replay repeats bit
        for bit; one with threads lets no frame wait for loops, and corrections come when they are
        there. ``maps`` may do their work in another thread.

        Raises:
            ConfigError: the prior cannot give what the config asks tracking for.
        """
        self.config, self.stages = config, stages or Stages()
        self.profiler, self.failures = self.stages.profiler, self.stages.failures
        self.prior = _prior_of(config)
        self.keyframes = KeyframeStore(work, self.prior)
        places = Places(self.keyframes, config.tracking)
        self._relative_poses = RelativePoses(self.keyframes, self.failures)
        self.gate = FrameGate(config.tracking.gate)
        self.overlays = OverlayFinder()
        self.metric = WorldFrames(self.keyframes, lambda: self.frames, config.fusion, self.failures)
        """Telemetry, and the frames in metres that it gives."""
        self.worker = worker or Worker(self.failures)
        """Looks for loops, for keyframes to return to, and for frames of before the map's start,
        and optimises the keyframe graph."""
        self.tracker = Tracker(
            self.prior, self.keyframes, config.tracking, places, self.failures,
            self.metric.motion, self.worker,
        )  # fmt: skip
        adjustment = config.tracking.adjustment
        self.adjuster = Adjuster(self.keyframes, adjustment, work)
        """Joint adjustments of keyframes."""
        self.graph = KeyframeGraph(
            self.keyframes, places, config.tracking, self.failures, self.metric,
            self.adjuster if adjustment.enabled else None,
            learned_scales(self.keyframes, self.prior.unit_sigma, config.tracking.learned),
            self.worker,
        )  # fmt: skip
        self.in_base: InBase | None = None
        """Where this dive lies in an earlier one; None: none was given."""
        self.maps: MapWork = maps or make_maps(config, self.stages, work, config.mapping.enabled)
        self._map_inputs = MapInputs(
            self.maps, self.keyframes, config.mapping, self.metric_frame, self._base_maps
        )
        self.skipped: Counter[str] = Counter()
        """Frames that the gate kept from tracking, by its reason's kind."""
        self.frames = FrameTable()
        """Finished frames, in completion order."""
        self.used = 0
        """Frames that passed the gate so far."""
        self._latest: int | None = None
        """The row of the frame linked last, if it has a pose."""
        self._passed = -1
        """The frame that passed the gate last."""
        self._duplicates: dict[int, list[Tracked]] = {}
        """By frame that passed the gate and is not finished yet, those that repeat it."""

    def localise_in(self, base: Base) -> None:
        """Look for this dive in an earlier one, whose frame it has once it was recognised there;
        before the first frame.

        Raises:
            InputError: the keypoints of ``base`` are those of another prior.
        """
        base.refuse_other_prior(self.prior.name)
        self.in_base = self.metric.base = InBase(
            base, self.keyframes, self.config.tracking, self.worker, self.failures
        )

    def process(self, frame: Frame) -> list[Tracked]:
        """One frame (paper, Sec. 3); returns every frame that it finished."""
        self.take_finished()  # by the worker: loops, returns to keyframes, frames of the past
        self._follow_graph(at_keyframe=False)  # Eq. 4: keyframes move, and the map with them
        frame = self._without_overlay(frame)
        verdict = self._gate(frame)
        if not verdict.passed:
            return self._skip(frame, verdict)
        step = self._track(frame)  # Eqs. 1 and 3
        return self._take(step)  # edges to the graph, frames to the maps, jobs to the worker

    def _take(self, step: Step) -> list[Tracked]:
        """The frames of a step, and the edges that it found, each to who needs it."""
        finished = []
        for depths in step.new_depths:
            with self.failures.contain("second solution"):
                self._carry(depths)
        for anchored in self._anchor(step.frames):
            linked = self._link(anchored, step.links)
            self._look_for_known_lengths(linked.tracked)
            self._map(linked.tracked)
            finished.append(self._publish(linked))
            finished += self._publish_duplicates(linked)
        for revisit in step.revisits:
            self._revisit(revisit)
        return finished

    def _carry(self, depths: NewDepths) -> None:
        """Not in the paper: the frames of a keyframe whose depths were solved again follow them,
        and so do their views."""
        T_wk = self.keyframes[depths.keyframe].T_wc
        self.frames.move(depths.keyframe, depths.correct)
        self.maps.carry(depths.keyframe, lambda T_wc: T_wk @ depths.correct(T_wk.inverse() @ T_wc))

    def take_finished(self, wait: bool = False) -> None:
        """Apply what the worker has found since; with ``wait``, all that was asked for."""
        if self.worker.waiting():
            with self.profiler.stage("graph"):
                for each in self.worker.take_finished(wait):
                    with self.failures.contain(each.stage, each.frame):
                        self._apply(each.found)

    def _apply(self, found: object) -> None:
        """Loops, keyframes to return to, keyframes that the base knows, frames of the past."""
        if isinstance(found, LoopsFound):
            self.graph.close_loops(found)
        elif isinstance(found, ReuseResult):
            revisit = self.tracker.return_to(found)
            if revisit is not None:
                self._revisit(revisit)
        elif isinstance(found, BaseLookup) and self.in_base is not None:
            self.in_base.take(found)
        elif isinstance(found, BackFillResult):
            self.tracker.looked_back(found)

    def catch_up(self) -> list[Tracked]:
        """In idle moments: poses of the past, which waited for a map (Sec. 3.2)."""
        newest = self._latest
        self.take_finished()
        with self.profiler.stage("back-fill"):
            step = self.tracker.back_fill()
        finished = self._take(step)
        self._latest = newest
        return finished

    def finish_tracking(self, until: Deadline | None = None) -> list[Tracked]:
        """After the last frame: the frames that still wait."""
        self.take_finished(wait=True)
        with self.profiler.stage("track"):
            step = self.tracker.finish(until)
        return self._take(step)

    def finish(
        self,
        progress: Callable[[int, int], None] | None = None,
        limits: FinishTime | None = None,
    ) -> list[Tracked]:
        """After the last frame: the frames that still wait, the last keyframe, the refinement; what
        is not needed for whole files stays within ``limits``."""
        limits = limits or FinishTime()
        finished = self.finish_tracking(limits.settling)
        self._settle_graph(limits.settling)
        with self.failures.contain("insertion"):
            self._map_inputs.retire_last()
        with self.failures.contain("refinement"):
            self.maps.refine(progress, limits.refining)
        settled = self.results(len(self.frames) - len(finished))
        return [
            replace(each, T_wc=now.T_wc, sub_map=now.sub_map)
            for each, now in zip(finished, settled, strict=True)
        ]

    def _settle_graph(self, until: Deadline) -> None:
        """The last optimisations, of loops and telemetry, and then the frames in metres."""
        self._wait_for_graph()
        self.metric.ask_anew()
        if not until.over:
            self.graph.adjust_everything()
            self._wait_for_graph()
        if self.metric.present:
            for _ in range(SETTLING_ROUNDS):
                if self.metric.strained and not until.over:
                    self.metric.ask_anew()
                    self.graph.straighten()
                    self._wait_for_graph()
            with self.profiler.stage("metric"):
                self.metric.update(self.graph.snapshot)

    def _wait_for_graph(self) -> None:
        self.take_finished(wait=True)
        self._correct(wait=True)
        while self.graph.optimising:
            self._correct(wait=True)

    def close(self, keep: bool = False) -> None:
        """End the background work; remove the files of the work folder, or ``keep`` them."""
        self.worker.close()
        self.keyframes.close(keep)
        self.maps.close(keep)

    @property
    def renderer(self) -> Renderer | None:
        """What the maps are drawn with, None without any; another one after a device failed."""
        return self.maps.renderer

    @property
    def mappers(self) -> dict[int, Mapper]:
        """The mappers by sub-map; complete after ``finish``."""
        return self.maps.mappers

    @property
    def held_out(self) -> dict[int, list[View]]:
        """Per sub-map, the views that were tracked but never mapped."""
        return self.maps.held_out

    def metric_frame(self, sub_map: int) -> WorldFrame:
        """Where a sub-map lies in the world, as far as telemetry has shown it by now."""
        return self.metric.of(sub_map)

    def _base_maps(self, sub_map: int) -> Mapping[Path, Sim3]:
        """The base's map files in the world of a sub-map, as far as it was recognised by now."""
        return {} if self.in_base is None else self.in_base.maps(sub_map)

    def metric_frames(self) -> dict[int, WorldFrame]:
        """The metric frames by sub-map, after ``finish``: how each world lies in n."""
        return {each.sub_map: self.metric_frame(each.sub_map) for each in self.keyframes.keyframes}

    # --- an earlier run -----------------------------------------------------------------------

    def resume(self, frames: FrameTable, used: int) -> None:
        """Take over the frames of an earlier run; ``used`` of them passed the gate."""
        self.frames, self.used = frames, used

    # --- the steps of a frame -----------------------------------------------------------------

    def _without_overlay(self, frame: Frame) -> Frame:
        """Not in the paper: what a recorder burned into the pictures is masked, as far as it is
        found by now."""
        if not self.config.tracking.mask_overlays:
            return frame
        masked = frame
        with self.stages("overlay", frame.index):
            masked = self.overlays.mask(frame)
        return masked

    def _gate(self, frame: Frame) -> GateVerdict:
        """Not in the paper: frames that cannot help are skipped before anything costly; it is
        decided here which of the others are held out."""
        verdict = GateVerdict(GateKind.PASS)
        with self.stages("gate", frame.index):
            verdict = self.gate.judge(frame.image, frame.mask)
        if verdict.passed:
            self._map_inputs.expect(frame.index, self.used)
            self.used += 1
            self._passed, self._duplicates[frame.index] = frame.index, []
        else:
            self.skipped[verdict.kind.value] += 1
        return verdict

    def _track(self, frame: Frame) -> Step:
        """Sec. 3.1, Eq. 1: encode the picture and match it to the keyframe in use; Sec. 3.2, Eq. 3:
        its Sim(3) pose, its class, and the poses of frames that waited for it."""
        with self.profiler.stage("track"):
            step = self.tracker.track(frame)
        if self.tracker.lost:
            self.gate.forget()
        return step

    def _anchor(self, tracked: list[Tracked]) -> list[RelativeFrame]:
        """T_kf of all frames, before a loop closure among them moves the keyframes."""
        return [self._relative_poses.relative_pose(each) for each in tracked]

    def _link(self, anchored: RelativeFrame, links: Mapping[int, KeyframeEdge]) -> RelativeFrame:
        """Sec. 3.2, Eq. 4: a new keyframe gets its edge, and loops to earlier ones are closed; the
        frame with its pose after that."""
        tracked, T_kf = anchored.tracked, anchored.T_kf
        if tracked.keyframe is None or T_kf is None:
            self._latest = None
            return anchored
        if tracked.frame_class is FrameClass.KEYFRAME:
            self._follow_graph(at_keyframe=True)
            index = tracked.frame.index
            with self.stages("graph", index):
                self.graph.add(tracked.keyframe, links.get(tracked.keyframe))
            if self.in_base is not None:
                with self.profiler.stage("base"):
                    self.in_base.look(tracked.keyframe)
        settled = self._relative_poses.world_pose(tracked, T_kf)
        linked = RelativeFrame(settled, None if settled.T_wc is None else T_kf)
        self._latest = None if linked.T_kf is None else len(self.frames)
        return linked

    def _revisit(self, revisit: Revisit) -> None:
        """Not in the paper: two keyframes that one frame was matched to get an edge."""
        with self.failures.contain("keyframe graph", self.keyframes[revisit.keyframe].frame_index):
            self.graph.revisit(revisit)

    def _look_for_known_lengths(self, tracked: Tracked) -> None:
        """In the pictures that the map is made from, if there is anything to look for."""
        sightings, mapped = self.metric.sightings, (FrameClass.KEYFRAME, FrameClass.MAPPING)
        if sightings.looks_for and tracked.T_wc is not None and tracked.frame_class in mapped:
            frame = tracked.frame
            with self.stages("look", frame.index):
                sightings.look(frame.index, frame.image, self.tracker.camera or frame.camera)

    def _map(self, tracked: Tracked) -> None:
        """Sec. 3.3.3, Eqs. 16 and 17: medium-guided insertion of Gaussians; Sec. 3.4, Eqs. 18 to
        23: joint optimisation of Gaussians and medium. Or the frame is held out."""
        with self.failures.contain("mapping", tracked.frame.index):
            self._map_inputs.add(tracked, self.tracker.camera or tracked.frame.camera)

    def _publish(self, anchored: RelativeFrame) -> Tracked:
        """The frame is finished: it has a row, from which its pose follows after every later
        correction."""
        self._map_inputs.forget(anchored.tracked.frame.index)
        self.frames.add(anchored.tracked, anchored.T_kf)
        return anchored.tracked

    # --- poses --------------------------------------------------------------------------------

    def _skip(self, frame: Frame, verdict: GateVerdict) -> list[Tracked]:
        """A frame that the gate refused; a duplicate has the pose of the frame that it repeats, and
        waits for it."""
        skipped = Tracked(
            without_pictures(frame), FrameClass.SKIPPED, self.tracker.sub_map, reason=verdict.reason
        )
        if verdict.same_place and self._passed in self._duplicates:
            self._duplicates[self._passed].append(skipped)
            return []
        if not verdict.same_place or self._latest is None:
            return [self._publish(RelativeFrame(skipped))]
        before, T_kf = self.frames[self._latest]
        return [self._publish(self._repeat(before, T_kf, skipped))]

    def _publish_duplicates(self, of: RelativeFrame) -> list[Tracked]:
        """Those of a frame that is finished."""
        waited = self._duplicates.pop(of.tracked.frame.index, [])
        return [self._publish(self._repeat(of.tracked, of.T_kf, each)) for each in waited]

    def _repeat(self, before: Tracked, T_kf: Sim3 | None, skipped: Tracked) -> RelativeFrame:
        """A duplicate with the pose of the frame ``before``, if that has one."""
        if T_kf is None:
            return RelativeFrame(skipped)
        repeated = replace(
            self._relative_poses.world_pose(before, T_kf), frame=skipped.frame,
            frame_class=skipped.frame_class, pointmap=None, reason=skipped.reason,
        )  # fmt: skip
        return RelativeFrame(repeated, None if repeated.T_wc is None else T_kf)

    def _follow_graph(self, at_keyframe: bool) -> None:
        """Take over what the graph's optimisation found: in step with the frames it is waited for
        at keyframes; else it is looked for between frames."""
        if at_keyframe is self.worker.in_step:
            self._correct(wait=at_keyframe)

    def _correct(self, wait: bool) -> None:
        """Keyframes move as the graph was optimised, and the map follows them."""
        if self.in_base is not None and self.in_base.has_news():
            self.graph.straighten()
        with self.stages("correct"):
            correction = self.graph.correction(wait)
            if correction.moves:
                self.maps.correct(correction.moves, correction.merged)

    def results(self, first: int = 0) -> list[Tracked]:
        """Finished frames from row ``first`` on, without pictures and reasons; pose and sub-map
        are those of now, after all corrections of keyframes."""
        return [
            self._relative_poses.world_pose(tracked, T_kf)
            for tracked, T_kf in self.frames.since(first)
        ]


# --------------------------------------------------------------------------------------------------
# The maps of a dive, and what tracked frames bring to them: views, some held out, and keyframes.
#
# With mapping off neither is loaded: both need torch, 100 MB that tracking alone has no use for.


def _prior_of(config: Config) -> Prior:
    prior = make_prior(config.prior)
    if config.tracking.residual == "point" and not prior.ranged:
        raise ConfigError(
            "tracking.residual 'point' needs points of each frame's own, which the "
            f"{prior.name} prior does not have; choose pixel or ray, or another prior"
        )
    return prior


def make_maps(
    config: Config,
    stages: Stages,
    work: Path | None,
    enabled: bool,
    threads: int | None = None,
) -> OwnedMaps:
    """Maps that are drawn in ``threads`` (None: as many as the config says, or the machine has);
    none of them where they are not ``enabled``."""
    if not enabled:
        return NoMaps(stages.profiler, stages.failures)
    from aquaflow.mapping.maps import Maps
    from aquaflow.render import select_renderer

    count = threads or config.threads or os.cpu_count()
    renderer = select_renderer(config.mapping.renderer, count)
    return Maps(config, renderer, stages.profiler, work, stages.failures)


class MapInputs:
    """Hands posed frames to the maps; to none with mapping off."""

    def __init__(
        self,
        maps: MapWork,
        keyframes: KeyframeStore,
        config: MappingConfig,
        frame_of: Callable[[int], WorldFrame],
        base_of: Callable[[int], Mapping[Path, Sim3]],
    ) -> None:
        """Of a sub-map: its ``frame_of`` the world as last estimated, and ``base_of`` the map files
        of the base, each with T_mb."""
        self._maps, self._keyframes, self._config = maps, keyframes, config
        self._frame_of, self._base_of = frame_of, base_of
        self._to_hold_out: set[int] = set()
        """Indices of the frames in tracking that the map shall not see."""
        self._views: dict[int, View] = {}
        """Of the keyframe in use, by its number."""

    def expect(self, index: int, i: int) -> None:
        """Frame ``index`` goes into tracking; it is decided here whether it is held out.

        i % n == 0 and i != 0, ``i`` counts used frames (docs/paper.md#deviations-evaluation).
        """
        every = self._config.hold_out_every
        if every > 0 and i != 0 and i % every == 0:
            self._to_hold_out.add(index)

    def add(self, tracked: Tracked, camera: CameraModel) -> None:
        """Hold a frame that has a pose out, or let its map grow by it."""
        if not self._config.enabled or tracked.T_wc is None:
            return
        view = _view(tracked, camera)
        if tracked.frame.index in self._to_hold_out:
            self._maps.hold_out(view, tracked.sub_map)
        else:
            self._maps.grow(self._growth(tracked, view))

    def forget(self, index: int) -> None:
        """Frame ``index`` is finished."""
        self._to_hold_out.discard(index)

    def retire_last(self) -> None:
        """After the last frame: insert the keyframe in use, with its depths as they are now."""
        for insertion in self._retire():
            self._maps.insert(insertion)

    def _growth(self, tracked: Tracked, view: View) -> Growth:
        """What the frame brings to the map; a new keyframe also retires the one before it."""
        retired: list[Insertion] = []
        if tracked.frame_class is FrameClass.KEYFRAME:
            retired = self._retire()
            self._views = {view.keyframe: view}
        steps = self._steps(tracked.frame_class)
        frame = self._frame_of(tracked.sub_map)
        unit = frame.T_nm.scale if frame.metric else None
        base = {} if tracked.pointmap is None else self._base_of(tracked.sub_map)
        return Growth(view, tracked.sub_map, steps, tracked.pointmap, tuple(retired), unit, base)

    def _retire(self) -> list[Insertion]:
        """The keyframe in use, with its pointmap as fused until now; from here on it is not."""
        retired, self._views = self._views, {}
        keyframes = self._keyframes
        return [
            Insertion(
                view, keyframes[number].sub_map, keyframes[number].pointmap,
                self._base_of(keyframes[number].sub_map),
            )
            for number, view in retired.items()
        ]  # fmt: skip

    def _steps(self, frame_class: FrameClass) -> int:
        optimiser = self._config.optimiser
        return {
            FrameClass.KEYFRAME: optimiser.steps_keyframe,
            FrameClass.MAPPING: optimiser.steps_mapping,
        }.get(frame_class, optimiser.steps_common)


def _view(tracked: Tracked, camera: CameraModel) -> View:
    from aquaflow.render.views import View

    assert tracked.T_wc is not None
    assert tracked.keyframe is not None
    return View(
        tracked.frame.index,
        tracked.frame.image,
        camera,
        tracked.T_wc,
        tracked.keyframe,
        robust=tracked.frame_class is FrameClass.COMMON,
        mask=tracked.frame.mask,
    )
