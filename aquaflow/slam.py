"""AquaFlow, the algorithm: frames in, poses and maps out. No files, no threads, no clocks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import replace

from aquaflow.config import Config
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.views import View
from aquaflow.messages import Frame
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.profiler import Profiler
from aquaflow.render import select_renderer
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.tracker import Tracker

MIN_VIEWS = 3
"""Fewer posed frames are not a map, and not worth refining."""


class Slam:
    """One dive: a tracker, its keyframes, and a map for every sub-map."""

    def __init__(self, config: Config, profiler: Profiler | None = None) -> None:
        self.config = config
        self.profiler = profiler or Profiler()
        self.prior = ClassicalPrior()
        self.keyframes = KeyframeStore()
        self.tracker = Tracker(self.prior, self.keyframes, config.tracking)
        self.renderer = select_renderer(config.mapping.renderer, config.threads or os.cpu_count())
        self.mappers: dict[int, Mapper] = {}
        self.held_out: dict[int, list[View]] = {}
        """Per sub-map, the views that were tracked but never mapped."""
        self._sequence: dict[int, int] = {}
        self._T_kf: dict[int, Sim3] = {}
        """By frame index: the pose against the frame's keyframe, which later corrections leave."""
        self._keyframe_views: dict[int, View] = {}

    def process(self, frame: Frame) -> list[Tracked]:
        """Everything the paper does with one frame; returns the frames whose fate it decided."""
        self._sequence[frame.index] = len(self._sequence)

        # Sec. 3.1 and 3.2: two-view prior, Sim(3) pose against the keyframe, frame class.
        with self.profiler.stage("track"):
            decided = self.tracker.track(frame)

        # Sec. 3.3 and 3.4: grow and optimise the map.
        for tracked in decided:
            self._map(tracked)
        return decided

    def finish(self, progress: Callable[[int, int], None] | None = None) -> list[Tracked]:
        """After the last frame: what is still undecided, the last keyframes, the refinement."""
        with self.profiler.stage("track"):
            decided = self.tracker.finish()
        for tracked in decided:
            self._map(tracked)
        self._retire_keyframes()
        with self.profiler.stage("refine"):
            for mapper in self.mappers.values():
                if len(mapper.views) >= MIN_VIEWS:
                    mapper.refine(progress)
        return decided

    def settled(self, results: Iterable[Tracked]) -> list[Tracked]:
        """The frames with pose and sub-map as they are now, after all corrections of keyframes."""
        return [self._settled(tracked) for tracked in results]

    def _settled(self, tracked: Tracked) -> Tracked:
        if tracked.keyframe is None:
            return tracked
        keyframe = self.keyframes[tracked.keyframe]
        T_wc = keyframe.T_wc @ self._T_kf[tracked.frame.index]
        return replace(tracked, T_wc=T_wc, sub_map=keyframe.sub_map)

    def _anchor(self, tracked: Tracked) -> None:
        if tracked.T_wc is not None and tracked.keyframe is not None:
            T_kw = self.keyframes[tracked.keyframe].T_wc.inverse()
            self._T_kf[tracked.frame.index] = T_kw @ tracked.T_wc

    def _map(self, tracked: Tracked) -> None:
        self._anchor(tracked)
        if tracked.T_wc is None or not self.config.mapping.enabled:
            return
        view = self._view(tracked)
        if self.is_held_out(tracked.frame):
            self.held_out.setdefault(tracked.sub_map, []).append(view)
            return
        with self.profiler.stage("view"):  # now and then a view makes the water be fitted again
            mapper = self._mapper(tracked.sub_map)
            mapper.add_view(view)

        # Sec. 3.3.3: medium-guided insertion, from this frame and from the keyframe it retires,
        # whose pointmap has been fused over its whole life.
        if tracked.frame_class is FrameClass.KEYFRAME:
            self._retire_keyframes()
            self._keyframe_views = {view.keyframe: view}
        if tracked.pointmap is not None:
            self._insert(mapper, view, tracked.pointmap)

        # Sec. 3.4: joint optimisation of Gaussians and water.
        with self.profiler.stage("optimise"):
            mapper.optimise(self._steps(tracked.frame_class))

    def is_held_out(self, frame: Frame) -> bool:
        """i % n == 0 and i != 0, i counting the frames that were used (DESIGN section 4)."""
        every, i = self.config.mapping.hold_out_every, self._sequence[frame.index]
        return every > 0 and i != 0 and i % every == 0

    def _retire_keyframes(self) -> None:
        """Insert once more from the keyframe in use, with its pointmap as fused until now."""
        for number, view in self._keyframe_views.items():
            keyframe = self.keyframes[number]
            self._insert(self._mapper(keyframe.sub_map), view, keyframe.pointmap)
        self._keyframe_views.clear()

    def _insert(self, mapper: Mapper, view: View, pointmap: Pointmap) -> None:
        with self.profiler.stage("insert"):
            mapper.insert(view, pointmap)

    def _mapper(self, sub_map: int) -> Mapper:
        if sub_map not in self.mappers:
            seed = self.config.seed + sub_map
            self.mappers[sub_map] = Mapper(self.config.mapping, self.renderer, seed)
        return self.mappers[sub_map]

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
