"""The maps of a dive, one for every sub-map, grown from tracked frames (Sec. 3.3, 3.4)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from aquaflow.config import Config
from aquaflow.errors import first_line, is_device_failure
from aquaflow.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.gaussians.reanchoring import move_views
from aquaflow.mapping.host_copies import HostCopies
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.view_budget import drop_surplus, same_group
from aquaflow.mapping.views import View, ViewStore
from aquaflow.profiler import Profiler
from aquaflow.render import cpu_renderer, select_renderer
from aquaflow.render.contract import Renderer

log = logging.getLogger(__name__)

MIN_VIEWS = 3
"""Fewer posed frames are not a map, and not worth refining."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Insertion:
    """A view and the depths of its pixels."""

    view: View
    sub_map: int
    pointmap: Pointmap


@dataclass(frozen=True)
class Growth:
    """The contribution of one posed frame to the map of its sub-map."""

    view: View
    sub_map: int
    steps: int
    """Of the optimiser, afterwards."""
    pointmap: Pointmap | None = None
    """Depths of the view's own pixels, if new Gaussians may come from it."""
    retired: tuple[Insertion, ...] = ()
    """Keyframes that this one relieves, with their pointmaps as fused over their whole life."""
    metres_per_unit: float | None = None
    """Of the sub-map; None while it is unknown."""


class MapWork(Protocol):
    """Tracking's requests to the maps; done at once, or in a thread."""

    @property
    def mappers(self) -> dict[int, Mapper]:
        """By sub-map. Owned by the mapping thread while it runs."""
        ...

    @property
    def renderer(self) -> Renderer:
        """What the maps are drawn with at the moment, and where."""
        ...

    @property
    def held_out(self) -> dict[int, list[View]]:
        """Per sub-map, the views that were tracked but never mapped."""
        ...

    def grow(self, growth: Growth) -> None:
        """Add a view, insert Gaussians, optimise."""
        ...

    def hold_out(self, view: View, sub_map: int) -> None:
        """Keep a view for evaluation; the map is never optimised on it."""
        ...

    def insert(self, insertion: Insertion) -> None:
        """Gaussians from a keyframe whose view the map has."""
        ...

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        """Move Gaussians and views with their keyframes; merge the maps of merged sub-maps."""
        ...

    def refine(self, progress: Progress | None = None) -> None:
        """After the last frame; the caller owns the maps from here on."""
        ...

    def close(self, keep: bool = False) -> None:
        """Remove the files of the work folder; or, to ``keep`` them, write the missing ones."""
        ...


class Maps:
    """Does the work in the caller's thread; for one thread at a time."""

    def __init__(
        self,
        config: Config,
        renderer: Renderer | None = None,
        profiler: Profiler | None = None,
        work: Path | None = None,
        failures: Failures | None = None,
    ) -> None:
        """What does not fit into memory waits in the folder ``work``, if there is one.

        The renderer is selected by the config if none is given. What a stage raises is counted in
        ``failures``; the map goes on without it.
        """
        self.config, self.profiler = config, profiler or Profiler()
        self.failures = failures or Failures()
        self.renderer = renderer or select_renderer(config.mapping.renderer, config.threads)
        self.mappers: dict[int, Mapper] = {}
        self.held_out: dict[int, list[View]] = {}
        self.views = ViewStore(work)
        self._copies = HostCopies()

    def grow(self, growth: Growth) -> None:
        view, number = growth.view, growth.sub_map
        with self.profiler.stage("view"):
            self._do("view", number, lambda mapper: self._add(view, mapper), view.frame_index)
        metres = growth.metres_per_unit
        if metres is not None and not self._do(
            "voxels in metres", number, lambda mapper: mapper.use_unit(metres), view.frame_index
        ):
            self.mapper(number).make_whole()

        # Sec. 3.3.3: medium-guided insertion, from this frame and from the keyframe it retires.
        for retired in growth.retired:
            self.insert(retired)
        if growth.pointmap is not None:
            self.insert(Insertion(view, number, growth.pointmap))

        # Sec. 3.4: joint optimisation of Gaussians and water.
        with self.profiler.stage("optimise"):
            self.optimise(number, growth.steps)
        self._do("copy of the map", number, lambda mapper: self._copies.grown(number, mapper))

    def _add(self, view: View, mapper: Mapper) -> None:
        self.views.keep(view)
        mapper.add_view(view)  # some views trigger another fit of the water
        group = same_group(view, mapper.views)
        drop_surplus(mapper.views, group, self.config.mapping.views_per_keyframe)

    def optimise(self, sub_map: int, steps: int) -> None:
        """Steps of the optimiser on a sub-map's map."""
        self._do("optimisation", sub_map, lambda mapper: mapper.optimise(steps))

    def hold_out(self, view: View, sub_map: int) -> None:
        views = self.held_out.setdefault(sub_map, [])
        views.append(self.views.keep(view))
        drop_surplus(views, views, self.config.mapping.held_out_most)

    def insert(self, insertion: Insertion) -> None:
        view, number = insertion.view, insertion.sub_map

        def insert(mapper: Mapper) -> None:
            mapper.insert(view, insertion.pointmap)

        with self.profiler.stage("insert"):
            if not self._do("insertion", number, insert, view.frame_index):
                self.mapper(number).make_whole()

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        for number in self.mappers:
            if self._change("correction of the map", number, lambda mapper: mapper.move(moves)):
                self._copies.moved(number, moves)
        for views in self.held_out.values():
            move_views(views, moves)
        for source, target in merged.items():
            self._merge(source, target)
            views = self.held_out.setdefault(target, [])
            views.extend(self.held_out.pop(source, []))
            drop_surplus(views, views, self.config.mapping.held_out_most)

    def _merge(self, source: int, target: int) -> None:
        """Merge two maps; a failure before the Gaussians were moved leaves both unchanged."""
        if source not in self.mappers:
            return
        before = len(self.mapper(target).gaussians)
        merged = self._change(
            "merging of maps", target, lambda mapper: mapper.absorb(self.mappers[source])
        )
        if merged or len(self.mapper(target).gaussians) > before:
            del self.mappers[source]
            self._do("copy of the map", target, lambda mapper: self._copies.take(target, mapper))

    def _change(self, stage: str, number: int, work: Callable[[Mapper], None]) -> bool:
        """A change that is made wholly, and once: a map that a failing device left half changed
        goes on from its copy, which is of before."""
        done = self._do(stage, number, work, changes=True)
        if not done:
            self.mapper(number).make_whole()
        return done

    def refine(self, progress: Progress | None = None) -> None:
        with self.profiler.stage("refine"):
            for number in self.mappers:
                if len(self.mappers[number].views) >= MIN_VIEWS:
                    self._do("refinement", number, lambda mapper: mapper.refine(progress))
                self.mappers[number].make_whole()

    # --- a device that fails --------------------------------------------------------------------

    def _do(
        self,
        stage: str,
        number: int,
        work: Callable[[Mapper], object],
        frame: int | None = None,
        changes: bool = False,
    ) -> bool:
        """Do ``work`` on map ``number``; what it raises is counted, and False returned.

        Where the map's device fails, all maps go on on the CPU, and the work is done there.
        """
        error = self._tried(stage, number, work, frame)
        if error is not None and self._device_failed(error):
            self._leave_device(error, number if changes else None)
            error = self._tried(stage, number, work, frame)
        return error is None

    def _tried(
        self, stage: str, number: int, work: Callable[[Mapper], object], frame: int | None
    ) -> Exception | None:
        """What ``work`` raised, if it was contained or the device's."""
        try:
            with self.failures.contain(stage, frame) as run:
                work(self.mapper(number))
        except Exception as error:
            if not self._device_failed(error):
                raise
            self.failures.record(stage, error, frame)
            return error
        return run.error

    def _device_failed(self, error: Exception) -> bool:
        return self.renderer.device.type != "cpu" and is_device_failure(error)

    def _leave_device(self, error: Exception, half_changed: int | None) -> None:
        """From here on all maps are drawn and optimised on the CPU."""
        log.warning(
            "%s failed (%s); the map goes on on the CPU, more slowly",
            self.renderer.device,
            first_line(error),
        )
        self.renderer = cpu_renderer(self.config.threads)
        for number, mapper in self.mappers.items():
            half = number == half_changed
            self.mappers[number] = self._copies.on_cpu(number, mapper, self.renderer, half)
        for view in (view for views in self.held_out.values() for view in views):
            view.begin_on(self.renderer.device)
        self._copies = HostCopies()

    def mapper(self, sub_map: int) -> Mapper:
        """The map of a sub-map, made when first asked for."""
        if sub_map not in self.mappers:
            seed = self.config.seed + sub_map
            self.mappers[sub_map] = Mapper(self.config.mapping, self.renderer, seed, self.failures)
        return self.mappers[sub_map]

    def close(self, keep: bool = False) -> None:
        self.views.close(keep)
