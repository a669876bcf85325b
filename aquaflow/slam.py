"""AquaFlow, the algorithm: frames in, poses and maps out. No clocks decide a replay's results."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from aquaflow.config import Config
from aquaflow.errors import ConfigError
from aquaflow.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.maps import Growth, Insertion, Maps, MapWork
from aquaflow.mapping.views import View
from aquaflow.messages import Frame
from aquaflow.prior.factory import make_prior
from aquaflow.profiler import Profiler
from aquaflow.render import select_renderer
from aquaflow.tracking.frame_table import FrameTable
from aquaflow.tracking.frames import FrameClass, Tracked, without_pictures
from aquaflow.tracking.gate.gate import FrameGate, GateKind, Verdict
from aquaflow.tracking.graph.keyframe_graph import KeyframeGraph
from aquaflow.tracking.loops.relocaliser import Places
from aquaflow.tracking.tracker import Tracker


@dataclass(frozen=True)
class Waiting:
    """A frame that passed the gate and is not finished."""

    used_before: int
    """Frames that passed the gate before it."""
    frame: Frame
    """Without its pictures."""


class Slam:
    """One dive: a tracker, its keyframes and their graph, and a map for every sub-map."""

    def __init__(
        self,
        config: Config,
        profiler: Profiler | None = None,
        work: Path | None = None,
        live: bool = False,
        maps: MapWork | None = None,
        failures: Failures | None = None,
    ) -> None:
        """What does not fit into memory waits in the folder ``work``, if there is one.

        A ``live`` run takes over an optimised keyframe graph as soon as it is there; a replay waits
        for it at the next keyframe, and so repeats bit for bit. ``maps`` may do their work in
        another thread. What a stage raises is counted in ``failures`` and costs that stage.

        Raises:
            ConfigError: the prior cannot give what the config asks tracking for.
        """
        if config.tracking.residual == "point":
            raise ConfigError(
                "tracking.residual 'point' needs points of each frame's own, which the classical "
                "prior does not have; choose pixel or ray"
            )
        self.config = config
        self.profiler = profiler or Profiler()
        self.failures = failures or Failures()
        self.prior = make_prior(config.prior)
        if live:
            self.prior.warm_up()
        self.keyframes = KeyframeStore(work, self.prior)
        places = Places(self.keyframes, config.tracking)
        self.gate = FrameGate(config.tracking.gate)
        self.tracker = Tracker(
            self.prior, self.keyframes, config.tracking, places, live, self.failures
        )
        self.graph = KeyframeGraph(self.keyframes, places, config.tracking, self.failures)
        self.renderer = select_renderer(config.mapping.renderer, config.threads or os.cpu_count())
        self.maps: MapWork = maps or Maps(config, self.renderer, self.profiler, work, self.failures)
        self.skipped: Counter[str] = Counter()
        """Frames that the gate kept from tracking, by its reason's kind."""
        self._live = live
        self.frames = FrameTable()
        """All frames whose fate is known, in the order in which it was decided."""
        self.used = 0
        """Frames that passed the gate so far."""
        self._waiting: dict[int, Waiting] = {}
        """By index, the frames that passed the gate and are not finished."""
        self._latest: tuple[Tracked, Sim3] | None = None
        """The frame placed last, if it has a pose, and that against its keyframe, T_kf."""
        self._keyframe_views: dict[int, View] = {}

    def process(self, frame: Frame) -> list[Tracked]:
        """Everything the paper does with one frame; returns the frames whose fate it decided."""
        # Sec. 3.2: what was optimised beside tracking; keyframes move, and the map follows.
        if self._live:
            self._correct(wait=False)

        # Not in the paper: is the frame worth looking at (docs/architecture.md#skips)?
        verdict = Verdict(GateKind.PASS)
        with self.profiler.stage("gate"), self.failures.contain("frame gate", frame.index):
            verdict = self.gate.judge(frame.image, frame.mask)
        if not verdict.passed:
            return [self._skip(frame, verdict)]
        self._waiting[frame.index] = Waiting(self.used, without_pictures(frame))
        self.used += 1

        # Sec. 3.1 and 3.2: two-view prior, Sim(3) pose against the keyframe, frame class.
        with self.profiler.stage("track"), self.failures.contain("tracking", frame.index) as run:
            decided = self.tracker.track(frame)
        if run.failed:
            decided = [self._as_lost(frame)]
        if self.tracker.lost:
            self.gate.forget()

        # Sec. 3.2: loops between keyframes, which start the next optimisation of their graph.
        # Sec. 3.3 and 3.4: grow and optimise the map.
        return self._place_all(decided)

    def catch_up(self) -> list[Tracked]:
        """In a live run's idle moments: poses of the past, which waited for a map (Sec. 3.2)."""
        newest, decided = self._latest, []
        with self.profiler.stage("back-fill"), self.failures.contain("back-filling"):
            decided = self.tracker.back_fill()
        placed = self._place_all(decided)
        self._latest = newest
        return placed

    def finish(self, progress: Callable[[int, int], None] | None = None) -> list[Tracked]:
        """After the last frame: what is still undecided, the last keyframes, the refinement."""
        decided: list[Tracked] = []
        with self.profiler.stage("track"), self.failures.contain("tracking"):
            decided = self.tracker.finish()
        placed = self._place_all(decided)
        placed += self._place_all([self._as_lost(left.frame) for left in self._left()])
        while self.graph.optimising:
            self._correct(wait=True)
        with self.failures.contain("insertion"):
            for insertion in self._retired_keyframes():
                self.maps.insert(insertion)
        with self.failures.contain("refinement"):
            self.maps.refine(progress)
        settled = self.results(len(self.frames) - len(placed))
        return [
            replace(tracked, T_wc=now.T_wc, sub_map=now.sub_map)
            for tracked, now in zip(placed, settled, strict=True)
        ]

    def close(self, keep: bool = False) -> None:
        """End the work beside tracking; remove what waits in the work folder, or ``keep`` it."""
        self.graph.close()
        self.keyframes.close(keep)
        self.maps.close(keep)

    @property
    def mappers(self) -> dict[int, Mapper]:
        """By sub-map; complete after ``finish``."""
        return self.maps.mappers

    @property
    def held_out(self) -> dict[int, list[View]]:
        """Per sub-map, the views that were tracked but never mapped."""
        return self.maps.held_out

    # --- an earlier run -----------------------------------------------------------------------

    def resume(self, frames: FrameTable, used: int) -> None:
        """Take over the frames of an earlier run; ``used`` of them passed the gate."""
        self.frames, self.used = frames, used

    # --- poses --------------------------------------------------------------------------------

    def _place_all(self, decided: list[Tracked]) -> list[Tracked]:
        """Anchor all frames before a loop among them moves the keyframes that they hang on."""
        # A frame on which a stage failed may be known already.
        decided = [tracked for tracked in decided if tracked.frame.index in self._waiting]
        anchored = [self._anchored(tracked) for tracked in decided]
        placed = [self._place(*each) for each in anchored]
        for tracked, (_, T_kf) in zip(placed, anchored, strict=True):
            self._waiting.pop(tracked.frame.index, None)
            self.frames.add(tracked, None if tracked.T_wc is None else T_kf)
        return placed

    def _left(self) -> list[Waiting]:
        """Frames that tracking no longer has: a stage failed that held them."""
        return list(self._waiting.values())

    def _as_lost(self, frame: Frame) -> Tracked:
        reason = self.failures.reason(frame.index) or "tracking failed"
        return Tracked.lost(frame, self.tracker.sub_map, reason)

    def _anchored(self, tracked: Tracked) -> tuple[Tracked, Sim3 | None]:
        """With the pose against the frame's keyframe, T_kf, which later corrections leave."""
        if tracked.keyframe is None or tracked.T_wc is None:
            return tracked, None
        with self.failures.contain("pose", tracked.frame.index):
            T_kf = self.keyframes[tracked.keyframe].T_wc.inverse() @ tracked.T_wc
            return tracked, T_kf.if_finite()
        return self._as_lost(tracked.frame), None

    def _place(self, tracked: Tracked, T_kf: Sim3 | None) -> Tracked:
        """Let the keyframe graph and the map know of a frame; its pose after that."""
        if tracked.keyframe is None or T_kf is None:
            self._latest = None
            return tracked
        if tracked.frame_class is FrameClass.KEYFRAME:
            if not self._live:
                self._correct(wait=True)
            index = tracked.frame.index
            with self.profiler.stage("graph"), self.failures.contain("keyframe graph", index):
                self.graph.add(tracked.keyframe, tracked.link)
        settled = self._settled(tracked, T_kf)
        self._latest = None if settled.T_wc is None else (settled, T_kf)
        if self.config.mapping.enabled and settled.T_wc is not None:
            with self.failures.contain("mapping", settled.frame.index):
                self._map(settled)
        return settled

    def _skip(self, frame: Frame, verdict: Verdict) -> Tracked:
        """A frame that was not looked at; one like the frame before it has that frame's pose."""
        self.skipped[verdict.kind.value] += 1
        if not verdict.same_place or self._latest is None:
            sub_map, T_kf = self.tracker.sub_map, None
            skipped = Tracked(frame, FrameClass.SKIPPED, sub_map, reason=verdict.reason)
        else:
            before, T_kf = self._latest
            skipped = replace(
                self._settled(before, T_kf), frame=frame, frame_class=FrameClass.SKIPPED,
                pointmap=None, reason=verdict.reason, link=None,
            )  # fmt: skip
        self.frames.add(skipped, None if skipped.T_wc is None else T_kf)
        return skipped

    def _correct(self, wait: bool) -> None:
        """The map follows its keyframes."""
        with self.profiler.stage("correct"):
            correction = self.graph.correction(wait)
        if correction.moves:
            with self.failures.contain("correction of the map"):
                self.maps.correct(correction.moves, correction.merged)

    def results(self, first: int = 0) -> list[Tracked]:
        """All frames whose fate is known, from the ``first`` decided on, without pictures and
        reasons, with pose and sub-map as they are now, after all corrections of keyframes."""
        return [self._settled(tracked, T_kf) for tracked, T_kf in self.frames.since(first)]

    def _settled(self, tracked: Tracked, T_kf: Sim3 | None) -> Tracked:
        """Where the frame is now; one whose pose cannot be computed has none."""
        if tracked.keyframe is None or T_kf is None:
            return tracked
        keyframe = self.keyframes[tracked.keyframe]
        with self.failures.contain("pose", tracked.frame.index):
            T_wc = (keyframe.T_wc @ T_kf).if_finite()
            return replace(tracked, T_wc=T_wc, sub_map=keyframe.sub_map)
        return self._as_lost(tracked.frame)

    # --- the map ------------------------------------------------------------------------------

    def _map(self, tracked: Tracked) -> None:
        view = self._view(tracked)
        if self.is_held_out(tracked.frame):
            self.maps.hold_out(view, tracked.sub_map)
            return
        retired: list[Insertion] = []
        if tracked.frame_class is FrameClass.KEYFRAME:
            retired = self._retired_keyframes()
            self._keyframe_views = {view.keyframe: view}
        steps = self._steps(tracked.frame_class)
        self.maps.grow(Growth(view, tracked.sub_map, steps, tracked.pointmap, tuple(retired)))

    def is_held_out(self, frame: Frame) -> bool:
        """i % n == 0 and i != 0, i counts used frames (docs/paper.md#deviations-evaluation)."""
        every, i = self.config.mapping.hold_out_every, self._waiting[frame.index].used_before
        return every > 0 and i != 0 and i % every == 0

    def _retired_keyframes(self) -> list[Insertion]:
        """The keyframe in use, with its pointmap as fused until now; from here on it is not."""
        retired, self._keyframe_views = self._keyframe_views, {}
        return [
            Insertion(view, self.keyframes[number].sub_map, self.keyframes[number].pointmap)
            for number, view in retired.items()
        ]

    def _steps(self, frame_class: FrameClass) -> int:
        optimiser = self.config.mapping.optimiser
        return {
            FrameClass.KEYFRAME: optimiser.steps_keyframe,
            FrameClass.MAPPING: optimiser.steps_mapping,
        }.get(frame_class, optimiser.steps_common)

    def _view(self, tracked: Tracked) -> View:
        assert tracked.T_wc is not None
        assert tracked.keyframe is not None
        camera = self.tracker.camera or tracked.frame.camera
        return View(
            tracked.frame.index,
            tracked.frame.image,
            camera,
            tracked.T_wc,
            tracked.keyframe,
            robust=tracked.frame_class is FrameClass.COMMON,
            mask=tracked.frame.mask,
        )
