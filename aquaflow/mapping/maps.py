"""The maps of a dive, one for every sub-map, grown from tracked frames (Sec. 3.3, 3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Profiler
from aquaflow.config import Config
from aquaflow.geometry.arrays import (
    Arrays,
    add_prefix,
    of_camera,
    of_sim3,
    to_camera,
    to_sim3,
    under,
)
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping import state
from aquaflow.mapping.base_gaussians import BaseMaps
from aquaflow.mapping.device_work import DeviceWork
from aquaflow.mapping.gaussians import move_views
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.mapping.tiles import TileFiles
from aquaflow.mapping.work import MIN_VIEWS, Growth, Insertion, Progress
from aquaflow.render import select_renderer
from aquaflow.render.contract import Renderer
from aquaflow.render.gsplat import give_back_idle, usable_share
from aquaflow.render.views import View, ViewStore, in_time


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
        renderer = renderer or select_renderer(config.mapping.renderer, config.threads)
        self.tiles = TileFiles(work)
        self._base = BaseMaps(self.failures)
        self._work = DeviceWork(config, renderer, self.failures, self.tiles)
        self.held_out: dict[int, list[View]] = {}
        self.views = ViewStore(work)

    @property
    def mappers(self) -> dict[int, Mapper]:
        return self._work.mappers

    @property
    def renderer(self) -> Renderer:
        return self._work.renderer

    @property
    def taken_over(self) -> int:
        return self._base.taken

    def grow(self, growth: Growth) -> None:
        view, number = growth.view, growth.sub_map
        do, index = self._work.do, view.frame_index
        with self.profiler.stage("view"):
            do("view", number, index, self._add, view)
        if growth.metres_per_unit is not None:
            do("voxels in metres", number, index, Mapper.use_unit, growth.metres_per_unit)

        # Sec. 3.3.3: medium-guided insertion, from this frame and from the keyframe it retires.
        for retired in growth.retired:
            self.insert(retired)
        if growth.pointmap is not None:
            self.insert(Insertion(view, number, growth.pointmap, growth.base))

        # Sec. 3.4: joint optimisation of Gaussians and water.
        with self.profiler.stage("optimise"):
            self.optimise(number, growth.steps)
        self._work.copy_grown(number)

    def _add(self, mapper: Mapper, view: View) -> None:
        self.views.keep(view)
        mapper.add_view(view)  # some views trigger another fit of the water
        group = same_group(view, mapper.views)
        most = self.config.mapping.views_per_keyframe
        mapper.forget(drop_surplus(mapper.views, group, most))

    def optimise(self, sub_map: int, steps: int) -> None:
        """Steps of the optimiser on a sub-map's map."""
        self._work.do("optimisation", sub_map, None, Mapper.optimise, steps)

    def hold_out(self, view: View, sub_map: int) -> None:
        views = self.held_out.setdefault(sub_map, [])
        views.append(self.views.keep(view))
        drop_surplus(views, views, self.config.mapping.held_out_most)

    def insert(self, insertion: Insertion) -> None:
        view, depths = insertion.view, insertion.pointmap
        with self.profiler.stage("insert"):
            base = self._base.placed(insertion.base)
            self._work.do(
                "insertion", insertion.sub_map, view.frame_index, Mapper.insert, view, depths, base
            )

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        for number in self.mappers:
            self._work.move(number, moves)
        for views in self.held_out.values():
            move_views(views, moves)
        for source, target in merged.items():
            self._merge(source, target)
            views = self.held_out.setdefault(target, [])
            views.extend(self.held_out.pop(source, []))
            drop_surplus(views, views, self.config.mapping.held_out_most)

    def carry(self, keyframe: int, carried: Callable[[Sim3], Sim3]) -> None:
        mapped = [mapper.views for mapper in self.mappers.values()]
        for views in [*mapped, *self.held_out.values()]:
            for view in views:
                if view.keyframe == keyframe:
                    view.T_wc = carried(view.T_wc).if_finite()

    def _merge(self, source: int, target: int) -> None:
        """Merge two maps; a failure before the Gaussians were moved leaves both unchanged."""
        if source not in self.mappers:
            return
        before = len(self._work.mapper(target).gaussians)
        merged = self._work.change("merging of maps", target, self._absorb, source)
        if merged or len(self._work.mapper(target).gaussians) > before:
            del self.mappers[source]
            self._work.copy(target)

    def _absorb(self, mapper: Mapper, source: int) -> None:
        mapper.absorb(self.mappers[source])

    def refine(self, progress: Progress | None = None, until: Deadline | None = None) -> None:
        """Maps share the time by their views."""
        limit = (until or Deadline()).within(self.config.mapping.optimiser.refine_seconds)
        views = {number: len(mapper.views) for number, mapper in self.mappers.items()}
        views = {number: count for number, count in views.items() if count >= MIN_VIEWS}
        with self.profiler.stage("refine"):
            for number in list(self.mappers):
                if number in views:
                    share = limit.share(views[number] / sum(views.values()))
                    self._work.do("refinement", number, None, Mapper.refine, progress, share)
                    del views[number]
                self._work.do("gathering of the map", number, None, Mapper.gather)
                self._work.mend(number)
                self._work.copy(number)

    def leave_device(self, why: str) -> bool:
        if self.renderer.device.type == "cpu":
            return False
        self._work.leave_device(why)
        return True

    def give_back_memory(self) -> None:
        """Free what the maps' device can do without: copies of pictures, and idle blocks."""
        self.views.drop_copies()
        give_back_idle(self.renderer.device)

    def usable_memory(self) -> float | None:
        return usable_share(self.renderer.device)

    def holds(self, view: View) -> bool:
        return self.views.holds(view)

    def save_pictures(self) -> list[Path]:
        return [*self.views.save(), *self.tiles.save()]

    @property
    def lost_pictures(self) -> set[int]:
        return self.views.lost

    def serialise(self) -> tuple[dict[str, Any], Arrays]:
        self.tiles.checkpoint()
        facts, arrays = serialise(self.mappers, self.held_out)
        facts["base"], waiting = self._base.serialise()
        return facts, arrays | add_prefix("base", waiting)

    def restore(
        self,
        facts: dict[str, Any],
        arrays: Arrays,  # as from serialise
    ) -> None:
        mappers, held_out = restore(facts, arrays, self.renderer, self.failures, self.tiles)
        self._base.restore(facts.get("base", {}), under("base", arrays))  # not before 2026-11-28
        for number, mapper in mappers.items():
            mapper.views = self.views.restore(mapper.views)
            self.mappers[number] = mapper
        for number, views in held_out.items():
            self.held_out[number] = self.views.restore(views)

    def close(self, keep: bool = False) -> None:
        self.views.close(keep)
        self.tiles.close(keep)


# --------------------------------------------------------------------------------------------------
# Limits the number of views: a long dive keeps only some of the views of each place.


def same_group(view: View, views: Sequence[View]) -> list[View]:
    """Those of ``views`` with the same keyframe and the same robustness as ``view``."""
    return [v for v in views if v.keyframe == view.keyframe and v.robust == view.robust]


def drop_surplus(
    views: list[View],
    group: Sequence[View],  # those of ``views`` that have a budget together
    most: int,
) -> list[View]:
    """Drop views, and their pixels, until the ``group`` has at most ``most``; those dropped.

    Always the one whose neighbours are nearest to each other in time, the earliest of equals, so
    that those that stay are spread over the whole time. First and last stay.
    """
    kept, surplus = in_time(group), list[View]()
    while len(kept) > max(most, 2):
        index = [view.frame_index for view in kept]
        gaps = [after - before for before, after in zip(index, index[2:])]  # noqa: B905
        dropped = kept.pop(1 + gaps.index(min(gaps)))
        views.remove(dropped)
        dropped.delete_pixels()
        surplus.append(dropped)
    return surplus


# --------------------------------------------------------------------------------------------------
# All maps of a dive as facts and arrays, for a checkpoint; their pictures are stored apart.


def serialise(
    mappers: Mapping[int, Mapper], held_out: Mapping[int, Sequence[View]]
) -> tuple[dict[str, Any], Arrays]:
    """Facts for JSON, and arrays, which are copies; both arguments are by sub-map."""
    facts: dict[str, Any] = {"maps": {}, "held_out": {}}
    arrays: Arrays = {}
    for number, mapper in mappers.items():
        facts["maps"][str(number)], parts = state.serialise(mapper, optimiser=True)
        arrays |= add_prefix(f"map{number}", parts)
    for number, views in held_out.items():
        facts["held_out"][str(number)], parts = _held_out(views)
        arrays |= add_prefix(f"held_out{number}", parts)
    return facts, arrays


def restore(
    facts: dict[str, Any],
    arrays: Arrays,  # as from serialised
    renderer: Renderer,
    failures: Failures,
    tiles: TileFiles | None = None,
) -> tuple[dict[int, Mapper], dict[int, list[View]]]:
    """Maps and held-out views by sub-map, as they were serialised, without their pictures.

    Raises:
        KeyError, ValueError, TypeError, RuntimeError: this is no such checkpoint.
    """
    mappers = {
        int(number): state.deserialise(
            values, under(f"map{number}", arrays), renderer, failures, tiles
        )
        for number, values in facts["maps"].items()
    }
    held_out = {
        int(number): _read_held_out(values, under(f"held_out{number}", arrays))
        for number, values in facts["held_out"].items()
    }
    return mappers, held_out


def _held_out(views: Sequence[View]) -> tuple[list[dict[str, Any]], Arrays]:
    """What was never learned from has a camera and a pose, and no more."""
    cameras = list(dict.fromkeys(view.camera for view in views))
    numbers = [(v.frame_index, v.keyframe, v.robust, cameras.index(v.camera)) for v in views]
    arrays = {
        "numbers": np.array(numbers, np.int64).reshape(-1, 4),
        "poses": of_sim3([view.T_wc for view in views]),
    }
    return [of_camera(camera) for camera in cameras], arrays


def _read_held_out(
    cameras: list[dict[str, Any]],
    arrays: Arrays,  # as from _held_out
) -> list[View]:
    known = [to_camera(values) for values in cameras]
    rows = zip(arrays["numbers"].tolist(), arrays["poses"], strict=True)
    return [
        View(index, NO_PIXELS, known[camera], to_sim3(pose), keyframe, bool(robust))
        for (index, keyframe, robust, camera), pose in rows
    ]
