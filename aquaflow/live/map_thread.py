"""Mapping in parallel to tracking: one thread that runs tracking's requests in order.

Tracking never waits for it, nor asks for results. Beyond the backlog limit common frames come as
views without steps of their own, then requests are dropped and counted, common frames first;
between requests the thread goes on optimising until every view has had its steps. Such a queue, in
which a checkpoint's job goes first, is no :class:`aquaflow.base.worker.Worker`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.worker import Lateness
from aquaflow.config.service import LiveMappingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.heartbeats import Heartbeats
from aquaflow.mapping.work import Growth, Insertion, OwnedMaps, Progress

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.render.contract import Renderer
    from aquaflow.render.views import View

log = logging.getLogger(__name__)

STAGE = "mapping"
"""Name of this thread among the heartbeats."""
IDLE_S = 0.2
"""Period of the heartbeats of an idle thread."""
STEPS_AT_ONCE = 4
"""Optimiser steps between two checks for a request in idle time: about 0.1 s at 480 px."""
FEWER = 4
"""At the level FEWER_STEPS, one of this many steps is done."""
JOIN_S = 30.0
"""Longest wait for the thread at the end of a dive."""
BACKLOG_SHARE = 0.5
"""Of the time until refining must end; frames that still wait for mapping then are left out."""
MAPPING_AT, KEYFRAME_AT = 3, 8
"""Backlogs of requests with steps after which mapping frames, and then keyframes, are left out."""
VIEW_AT = 8
"""Backlogs of all requests after which common frames are left out: each holds a picture."""

Job = Callable[[OwnedMaps], None]


@dataclass(frozen=True)
class MapCorrection:
    """Keyframes that moved, and sub-maps that became one."""

    moves: Mapping[int, Sim3]
    merged: Mapping[int, int]

    def __call__(self, maps: OwnedMaps) -> None:
        maps.correct(self.moves, self.merged)


class MapThread:
    """The :class:`aquaflow.mapping.work.MapWork` of a live run."""

    def __init__(
        self,
        maps: OwnedMaps,
        config: LiveMappingConfig,
        heartbeats: Heartbeats,
        level: Callable[[], DegradationLevel] = lambda: DegradationLevel.FULL,
        lateness: Lateness | None = None,
    ) -> None:
        self.left_out: Counter[str] = Counter()
        """Frames that the map never saw, by reason."""
        self.without_steps = 0
        """Common frames that came as views alone: idle time and refining learn from them."""
        self.failures = 0
        """Requests that raised an error; each was skipped."""
        self.last_failure = ""
        self.failing = False
        """The last request raised, or found the GPU's memory full."""
        self.lateness = lateness or Lateness()
        """Of tracking, to which the thread gives way after each request."""
        self._maps, self._config, self._heartbeats, self._level = maps, config, heartbeats, level
        self._jobs: deque[tuple[str, Job]] = deque()
        self._inspections: deque[tuple[str, Job]] = deque()
        """They come before all others, and also while the thread rests."""
        self._growing = 0
        """Growth requests with steps in the queue."""
        self._newest: int | None = None
        """The sub-map that grew last."""
        self._changed = threading.Condition()
        self._ending = threading.Event()
        self._until = Deadline()
        """When frames that wait for mapping are left out, at the end of a dive."""
        self._given_back_at = DegradationLevel.FULL
        """The level at the last look; memory is given back at each step down."""
        self._thread = threading.Thread(target=self._run, name=STAGE, daemon=True)
        self._thread.start()

    # --- what tracking asks for -----------------------------------------------------------------

    def grow(self, growth: Growth) -> None:
        refused = self._refuse_growth(growth)
        if refused is not None:
            self.left_out[refused] += 1
            return
        level = self._level()
        growth = replace(growth, retired=tuple(map(_own_pointmap, growth.retired)))
        if growth.view.robust and self._growing >= self._config.backlog:
            growth = replace(growth, steps=0)
            self.without_steps += 1
        if level >= DegradationLevel.FEWER_STEPS:
            growth = replace(growth, steps=growth.steps // FEWER)
        if level >= DegradationLevel.SMALLER_IMAGES:
            growth = halve(growth)
        with self._changed:
            self._growing += growth.steps > 0
        self._post("grow", partial(self._grow, growth))

    def hold_out(self, view: View, sub_map: int) -> None:
        if self._level() < DegradationLevel.TRACKING_ONLY:
            self._post("hold out", lambda maps: maps.hold_out(view, sub_map))

    def insert(self, insertion: Insertion) -> None:
        self._post("insert", partial(_insert, _own_pointmap(insertion)))

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        self._post("correct", MapCorrection(moves, merged))

    def carry(self, keyframe: int, carried: Callable[[Sim3], Sim3]) -> None:
        self._post("carry", lambda maps: maps.carry(keyframe, carried))

    def inspect(self, name: str, job: Callable[[OwnedMaps, list[MapCorrection]], None]) -> None:
        """Run ``job`` on the maps before all waiting requests; its second argument is the
        corrections that tracking has made and the maps do not contain yet."""
        with self._changed:
            lacking = [job for _, job in self._jobs if isinstance(job, MapCorrection)]
            self._inspections.append((name, lambda maps: job(maps, lacking)))
            self._changed.notify()

    def later(self, name: str, job: Job) -> None:
        """Run ``job`` on the maps after all waiting requests."""
        self._post(name, job)

    def refine(self, progress: Progress | None = None, until: Deadline | None = None) -> None:
        self._until = (until or Deadline()).share(BACKLOG_SHARE)
        self._end()
        if self._level() is DegradationLevel.FULL:  # what fails here must not cost the map as it is
            self._do("refine", lambda maps: maps.refine(self._beating(progress), until))
        self._heartbeats.retire(STAGE)

    def leave_device(self, why: str) -> bool:
        return self._maps.leave_device(why)

    def close(self, keep: bool = False) -> None:
        self._end()
        self._heartbeats.retire(STAGE)
        self._maps.close(keep)

    @property
    def mappers(self) -> dict[int, Mapper]:
        return self._maps.mappers

    @property
    def taken_over(self) -> int:
        return self._maps.taken_over

    @property
    def renderer(self) -> Renderer | None:
        return self._maps.renderer

    @property
    def held_out(self) -> dict[int, list[View]]:
        return self._maps.held_out

    def usable_memory(self) -> float | None:
        """Usable share of the maps' device, as
        :meth:`aquaflow.mapping.work.OwnedMaps.usable_memory`."""
        return self._maps.usable_memory()

    @property
    def waiting(self) -> int:
        """Requests in the queue."""
        return len(self._inspections) + len(self._jobs)

    # --- the thread -----------------------------------------------------------------------------

    def _refuse_growth(self, growth: Growth) -> str | None:
        if self._level() >= DegradationLevel.TRACKING_ONLY:
            return "tracking only"
        backlog, waiting = self._config.backlog, self._growing
        if self.waiting >= VIEW_AT * backlog and growth.view.robust:
            return "common frame, mapping was behind"
        if waiting >= MAPPING_AT * backlog and not growth.retired:
            return "mapping frame, mapping was behind"
        if waiting >= KEYFRAME_AT * backlog:
            return "keyframe, mapping was behind"
        return None

    def _post(self, name: str, job: Job) -> None:
        with self._changed:
            self._jobs.append((name, job))
            self._changed.notify()

    def _grow(self, growth: Growth, maps: OwnedMaps) -> None:
        with self._changed:
            self._growing -= growth.steps > 0
        if self._until.over:
            self.left_out["the dive ended before mapping had caught up"] += 1
            return
        retired = tuple(each for each in growth.retired if _is_mapped(each, maps))
        maps.grow(replace(growth, retired=retired))
        self._newest = growth.sub_map

    def _run(self) -> None:
        with contextlib.suppress(OSError):  # a sandbox may forbid it
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._config.nice)
        while True:
            self._heartbeats.beat(STAGE)
            self._give_back_memory()
            job = self._next()
            if job is None and self._ending.is_set():
                return
            began_s = time.monotonic()
            self._do(*job or ("optimise", self._optimise))
            if not self._ending.is_set():
                self.lateness.rest(time.monotonic() - began_s, meanwhile=self._inspect)

    def _give_back_memory(self) -> None:
        level, before = self._level(), self._given_back_at
        self._given_back_at = level
        if level > before:
            with self._maps.failures.contain("giving memory back"):
                self._maps.give_back_memory()

    def _next(self) -> tuple[str, Job] | None:
        """The next request; None at once if a map can be optimised meanwhile."""
        with self._changed:
            idle = self.failing or not self._wanting()
            if not self.waiting and not self._ending.is_set() and idle:
                self._changed.wait(IDLE_S)
            queue = self._inspections or self._jobs
            return queue.popleft() if queue else None

    def _inspect(self) -> None:
        while self._inspections:
            self._do(*self._inspections.popleft())

    def _do(self, name: str, job: Job) -> None:
        # A request that fails (a GPU that is gone, a file that cannot be read) is skipped; so is
        # one for which the memory or the disk is full: this thread has no caller to raise to.
        failures = self._maps.failures
        full = failures.device_full
        try:
            job(self._maps)
            self.failing = failures.device_full > full
            if self.failing:
                self.last_failure = f"{name}: the GPU's memory was full"
        except Exception as error:
            failures.record(f"map: {name}", error)
            self.last_failure = f"{name}: {error}"
            self.failures, self.failing = self.failures + 1, True

    def _wanting(self) -> Mapper | None:
        """The map to optimise in idle time, if it still needs steps and tracking is in time."""
        if self._newest is None or self._level() is not DegradationLevel.FULL:
            return None
        if self.lateness.late:
            return None
        mapper = self._maps.mappers.get(self._newest)
        if mapper is None or len(mapper.gaussians) == 0:
            return None
        wanted = self._config.steps_per_view * len(mapper.views)
        return mapper if sum(view.looks for view in mapper.views) < wanted else None

    def _optimise(self, maps: OwnedMaps) -> None:
        if self._newest is not None and self._wanting() is not None:
            with maps.profiler.stage("optimise"):
                maps.optimise(self._newest, STEPS_AT_ONCE)

    def _beating(self, progress: Progress | None) -> Progress:
        def beat(done: int, total: int) -> None:
            self._heartbeats.beat(STAGE)
            if progress is not None:
                progress(done, total)

        return beat

    def _end(self) -> None:
        """Run all waiting requests and end the thread, which owns the maps until then."""
        with self._changed:
            self._ending.set()
            self._changed.notify()
        while self._thread.is_alive():  # the watchdog ends the process if the thread hangs
            self._thread.join(JOIN_S)


def _own_pointmap(insertion: Insertion) -> Insertion:
    """With a pointmap of its own: tracking goes on fusing into that of a keyframe which it takes up
    again."""
    return replace(insertion, pointmap=insertion.pointmap.copy())


def _is_mapped(insertion: Insertion, maps: OwnedMaps) -> bool:
    """True if the map has the view, at its full size."""
    return maps.holds(insertion.view)


def _insert(insertion: Insertion, maps: OwnedMaps) -> None:
    if _is_mapped(insertion, maps):
        maps.insert(insertion)


# --------------------------------------------------------------------------------------------------
# New views of the map at half the width: a quarter of the pixels to keep and to draw.


def halve(growth: Growth) -> Growth:
    """The same growth at half the picture width."""
    view = growth.view
    width, height = view.camera.width // 2, view.camera.height // 2
    small = view.with_pixels(
        _picture(view, width, height),
        view.camera.resize(width, height),
        None if view.mask is None else view.mask[1 : 2 * height : 2, 1 : 2 * width : 2].copy(),
    )
    pointmap = growth.pointmap
    if pointmap is not None:
        pointmap = _pointmap(pointmap, small)
    return replace(growth, view=small, pointmap=pointmap)


def _picture(view: View, width: int, height: int) -> npt.NDArray[np.uint8]:
    import cv2

    whole = view.image[: 2 * height, : 2 * width]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _pointmap(pointmap: Pointmap, small: View) -> Pointmap:
    rows = slice(1, 2 * small.camera.height, 2)
    columns = slice(1, 2 * small.camera.width, 2)
    rho, variance = pointmap.rho[rows, columns], pointmap.variance[rows, columns]
    learned = pointmap.learned
    if learned is not None:
        half_rho, half_variance = learned.rho[rows, columns], learned.variance[rows, columns]
        learned = replace(learned, rho=half_rho, variance=half_variance)
    return Pointmap(small.camera, rho.copy(), variance.copy(), learned=learned)
