"""The maps of a dive, one for every sub-map, grown from tracked frames (Sec. 3.3, 3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from aquaflow.config import Config
from aquaflow.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.gaussians.reanchoring import move_views
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.view_budget import drop_surplus, same_group
from aquaflow.mapping.views import View, ViewStore
from aquaflow.profiler import Profiler
from aquaflow.render import select_renderer
from aquaflow.render.contract import Renderer

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


class MapWork(Protocol):
    """Tracking's requests to the maps; done at once, or in a thread."""

    @property
    def mappers(self) -> dict[int, Mapper]:
        """By sub-map. Owned by the mapping thread while it runs."""
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

    def grow(self, growth: Growth) -> None:
        view = growth.view
        with self.profiler.stage("view"):
            mapper = self.mapper(growth.sub_map)
            with self.failures.contain("view", view.frame_index):
                self.views.keep(view)
                mapper.add_view(view)  # some views trigger another fit of the water
                group = same_group(view, mapper.views)
                drop_surplus(mapper.views, group, self.config.mapping.views_per_keyframe)

        # Sec. 3.3.3: medium-guided insertion, from this frame and from the keyframe it retires.
        for retired in growth.retired:
            self.insert(retired)
        if growth.pointmap is not None:
            self.insert(Insertion(view, growth.sub_map, growth.pointmap))

        # Sec. 3.4: joint optimisation of Gaussians and water.
        with self.profiler.stage("optimise"):
            mapper.optimise(growth.steps)

    def hold_out(self, view: View, sub_map: int) -> None:
        views = self.held_out.setdefault(sub_map, [])
        views.append(self.views.keep(view))
        drop_surplus(views, views, self.config.mapping.held_out_most)

    def insert(self, insertion: Insertion) -> None:
        mapper, frame = self.mapper(insertion.sub_map), insertion.view.frame_index
        with self.profiler.stage("insert"), self.failures.contain("insertion", frame) as insert:
            mapper.insert(insertion.view, insertion.pointmap)
        if insert.failed:
            mapper.make_whole()

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        for mapper in self.mappers.values():
            with self.failures.contain("correction of the map") as run:
                mapper.move(moves)
            if run.failed:
                mapper.make_whole()
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
        mapper, other = self.mapper(target), self.mappers[source]
        before = len(mapper.gaussians)
        with self.failures.contain("merging of maps") as merge:
            mapper.absorb(other)
        if merge.failed:
            mapper.make_whole()
        if not merge.failed or len(mapper.gaussians) > before:
            del self.mappers[source]

    def refine(self, progress: Progress | None = None) -> None:
        with self.profiler.stage("refine"):
            for mapper in self.mappers.values():
                if len(mapper.views) >= MIN_VIEWS:
                    with self.failures.contain("refinement"):
                        mapper.refine(progress)
                mapper.make_whole()

    def mapper(self, sub_map: int) -> Mapper:
        """The map of a sub-map, made when first asked for."""
        if sub_map not in self.mappers:
            seed = self.config.seed + sub_map
            self.mappers[sub_map] = Mapper(self.config.mapping, self.renderer, seed, self.failures)
        return self.mappers[sub_map]

    def close(self, keep: bool = False) -> None:
        self.views.close(keep)
