"""Coverage while the dive goes on: a thread of its own, which tracking never waits for.

Tracking's thread leaves a place for each picture; everything else is read from the keyframe store
and computed here, for at most ``SHARE`` of a core.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors.failures import Failures
from aquaflow.config.service import CoverageConfig
from aquaflow.dive.views import CoverageView, RunningDive
from aquaflow.mapping.work import OwnedMaps
from aquaflow.survey.coverage.coverage_files import CoverageFiles
from aquaflow.survey.coverage.dive_coverage import DiveCoverage
from aquaflow.survey.coverage.footprint import mapping_range
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.coverage.picture import cells_affine, cells_png, coverage_png
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.coverage.swath import MOST_SIGHTS, extent

log = logging.getLogger(__name__)

TURN_S = 1.0
"""Between two turns: keyframes come about once a second."""
SHARE = 0.05
"""Of one core, at most; a turn costs 5 to 40 ms."""
WATER_S = 20.0
"""Between two looks at the water, which changes with its fits."""
PLACES = 200
"""Places that are kept for the speed: 5 s at 40 pictures a second."""
NO_VIEWS: Mapping[int, PageView] = MappingProxyType({})


class LiveCoverage(CoverageView):
    """Construct once; :meth:`show` and :meth:`hide` a dive; asked from any thread."""

    def __init__(
        self,
        failures: Failures,
        now_s: Callable[[], float] = time.monotonic,
        cpu_s: Callable[[], float] = time.thread_time,
    ) -> None:
        """``cpu_s``: what the calling thread has used."""
        self.hints: tuple[Hint, ...] = ()
        """That hold now."""
        self.turns, self.took_s = 0, 0.0
        """Turns so far, and the CPU time that they took."""
        self._failures, self._now_s, self._cpu_s = failures, now_s, cpu_s
        self._dive: RunningDive | None = None
        self._views: Mapping[int, PageView] = NO_VIEWS
        self._hints: Hints | None = None
        self._measured = CoverageFigures()
        self._places: deque[TrackedPlace] = deque(maxlen=PLACES)
        self._limits: dict[int, float | None] = {}
        self._water_s = -WATER_S
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coverage", daemon=True)
        self._thread.start()

    # --- in the service's threads ---------------------------------------------------------------

    def show(self, dive: RunningDive) -> None:
        """From here on, this dive."""
        self.hide()
        coverage = coverage_of(dive)
        if coverage is not None:
            self._hints = Hints(coverage.config)
            self._dive = dive

    def hide(self) -> None:
        """From here on, none."""
        self._dive, self._hints, self._views, self.hints = None, None, NO_VIEWS, ()
        self._measured, self._limits, self._water_s = CoverageFigures(), {}, -WATER_S
        self._places.clear()

    def update(self, dive: RunningDive) -> None:
        """In tracking's thread: notes where the newest picture was taken."""
        latest = dive.latest
        if latest is None or latest.T_wc is None:
            return
        t_s = latest.frame.t_ns * 1e-9
        if not self._places or self._places[-1].t_s != t_s:
            self._places.append(TrackedPlace(t_s, latest.sub_map, latest.T_wc.t))

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join(5.0)

    # --- what the pilot is told, and what the page asks for -------------------------------------

    def sentences(self) -> tuple[str, ...]:
        """The hints that hold, each fit for one STATUSTEXT."""
        return tuple(SENTENCES[hint] for hint in self.hints)

    def to_json(self) -> dict[int, dict[str, Any]]:
        """What the page shows, by sub-map: the picture of the cells and how it lies on the page,
        lines and areas."""
        return {number: describe(view) for number, view in self._views.items()}

    def in_words(self) -> list[str]:
        """The hints that hold, with their values."""
        measured, words = self._measured, []
        for hint in self.hints:
            value = {
                Hint.TOO_HIGH: measured.range_share,
                Hint.TOO_FAST: measured.forward_overlap,
                Hint.TOO_FAR_ASIDE: measured.line_overlap,
            }[hint]
            said = "" if value is None else f": {100 * value:.0f} %"
            words.append(hint.value + said)
        return words

    def png(self) -> bytes | None:
        """The finished picture of the newest sub-map; None before there is one."""
        views = self._views
        if not views:
            return None
        newest = self._places[-1].sub_map if self._places else max(views)
        return coverage_png(views.get(newest, views[max(views)]), "; ".join(self.in_words()))

    def cells(self, sub_map: int) -> bytes | None:
        """The picture of a sub-map's cells alone; None where there is none."""
        view = self._views.get(sub_map)
        return None if view is None else cells_png(view)

    def plan(self, sub_map: int) -> CoveragePlan | None:
        """The cells of a sub-map as they are known by now; None where there are none."""
        view = self._views.get(sub_map)
        return None if view is None else view.plan

    # --- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        pause = TURN_S
        while not self._closing.wait(pause):
            before_s = self._cpu_s()
            with self._failures.contain("coverage"):
                self.turn()
            took_s = self._cpu_s() - before_s
            self.took_s += took_s
            pause = max(TURN_S, took_s / SHARE)

    def turn(self) -> None:
        """Take in what is new, and show it."""
        dive, hints = self._dive, self._hints
        coverage = None if dive is None else coverage_of(dive)
        if dive is None or hints is None or coverage is None:
            return
        self._ask_for_the_water(dive)
        slam = dive.dive_run.slam
        coverage.look(slam.keyframes, slam.metric_frame)
        coverage.update()
        views = coverage.views(slam.keyframes, slam.metric_frame, self._limits)
        measured = self._judge(coverage, views)
        if self._dive is dive:  # else the dive ended meanwhile
            self.turns += 1
            self._views, self._measured = views, measured
            self.hints = hints.judge(measured)

    def _judge(self, coverage: DiveCoverage, views: Mapping[int, PageView]) -> CoverageFigures:
        """The newest values of what hints are about."""
        if not self._places:
            return CoverageFigures()
        sub_map, ways = self._places[-1].sub_map, forward_steps(self._places)
        view, own = views.get(sub_map), coverage.sub_maps.get(sub_map)
        if view is None or own is None:
            return CoverageFigures()
        with coverage.lock:
            newest = [own.seen[number] for number in sorted(own.seen)[-MOST_SIGHTS:]]
        measured = CoverageFigures(line_overlap=view.state.overlap)
        limit = self._limits.get(sub_map)
        if newest and limit:
            footprint, T_mc = newest[-1]
            measured.range_share = T_mc.scale * footprint.depth / limit
        steps = np.linalg.norm(ways, axis=1)
        total = ways.sum(axis=0)
        if newest and len(steps) and np.linalg.norm(total) > 0.0:
            length = extent(newest, total / np.linalg.norm(total))
            if length > 0.0:
                measured.forward_overlap = 1.0 - float(np.median(steps)) / length
        return measured

    def _ask_for_the_water(self, dive: RunningDive) -> None:
        """The mapping thread answers when it finds time; it is not waited for."""
        now = self._now_s()
        if now - self._water_s < WATER_S:
            return
        self._water_s, config = now, dive.dive_run.config.coverage

        def read(maps: OwnedMaps, _: object) -> None:
            if not maps.mappers:
                return
            from aquaflow.dive.map_file import attenuations  # loads torch

            for number, attenuation in attenuations(maps.mappers).items():
                self._limits[number] = mapping_range(attenuation, config.least_contrast)

        dive.maps.inspect("water for the coverage", read)


def coverage_of(dive: RunningDive) -> DiveCoverage | None:
    """What the camera has seen in the dive; None where that is switched off."""
    made = dive.dive_run.deliverables.get("coverage")
    return made.coverage if isinstance(made, CoverageFiles) else None


def describe(view: PageView) -> dict[str, Any]:
    """The plan for the page: lengths in the view's unit, places right and up."""
    state, plan = view.state, view.plan
    suggestion = state.suggestion
    return {
        "size": [plan.classes.shape[1], plan.classes.shape[0]],
        "to_page": np.round(cells_affine(view), 6).tolist(),
        "areas": view.areas and {name: round(area, 3) for name, area in view.areas.items()},
        "range_limit": None if plan.limit is None else round(plan.limit * view.scale, 3),
        "swath": round(state.swath, 3),
        "overlap": None if state.overlap is None else round(state.overlap, 3),
        "lines": [np.round([line.start, line.end], 3).tolist() for line in state.lines],
        "next_line": None if suggestion is None else {
            "places": np.round([suggestion.start, suggestion.end], 3).tolist(),
            "new_share": round(suggestion.gain, 3),
        },
    }  # fmt: skip


# --------------------------------------------------------------------------------------------------
# What a pilot could do better at the moment: slower, lower, nearer to the last line.

Array = npt.NDArray[np.float64]

LOOKED_BACK_S = 5.0
"""Seconds of the path that the speed is taken from: a burst of thrust is no speed."""
LEAST_STEPS = 5
"""Pairs of pictures in it, below which nothing is said."""
MARGIN = 0.05
"""Share by which a value must be better again until a hint ends, so that it does not flicker."""
FURTHER = 0.15
"""Share of the swath by which a line may overlap less than is wanted; half of that ends it."""


class Hint(str, Enum):
    """In the order in which a pilot should hear of them."""

    TOO_HIGH = "too high for this water"
    TOO_FAST = "too fast for the wanted overlap"
    TOO_FAR_ASIDE = "too far from the last line"


SENTENCES = {hint: f"AquaFlow: {hint.value}." for hint in Hint}
"""As a ground station speaks them: whole, without numbers, and fit for one STATUSTEXT."""


@dataclass(frozen=True)
class TrackedPlace:
    """Where the camera was when a picture was tracked."""

    t_s: float
    sub_map: int
    t_m: Array
    """[3] in the sub-map's world."""


@dataclass
class CoverageFigures:
    """What hints are judged by; None: not known."""

    forward_overlap: float | None = None
    """Of one tracked picture with the next, share of what it shows along the path; median."""
    range_share: float | None = None
    """Range of the newest keyframe's view over that which the water allows."""
    line_overlap: float | None = None
    """Of the newest line with the last one beside it."""


@dataclass
class Hints:
    """The hints that hold; each begins and ends at values that differ."""

    config: CoverageConfig
    holding: set[Hint] = field(default_factory=set)

    def judge(self, measured: CoverageFigures) -> tuple[Hint, ...]:
        """The hints that hold now."""
        wanted, line, share = self.config.forward_overlap, self.config.overlap, measured.range_share
        room = None if share is None else 1.0 - share
        self._set(Hint.TOO_HIGH, room, 0.0, 2 * MARGIN)
        self._set(Hint.TOO_FAST, measured.forward_overlap, wanted, wanted + MARGIN)
        self._set(Hint.TOO_FAR_ASIDE, measured.line_overlap, line - FURTHER, line - 0.5 * FURTHER)
        return tuple(hint for hint in Hint if hint in self.holding)

    def _set(self, hint: Hint, value: float | None, begins: float, ends: float) -> None:
        """Below ``begins`` it holds, from ``ends`` on it does not; of an unknown it does not."""
        if value is None or value >= ends:
            self.holding.discard(hint)
        elif value < begins:
            self.holding.add(hint)


def forward_steps(
    places: deque[TrackedPlace],
) -> Array:
    """[K, 3] the ways from each picture of the newest seconds to the next, in the world of the
    newest one's sub-map; none where there are too few."""
    held = list(places)
    if not held:
        return np.zeros((0, 3))
    newest = held[-1]
    recent = [
        each.t_m
        for each in held
        if each.sub_map == newest.sub_map and newest.t_s - each.t_s <= LOOKED_BACK_S
    ]
    return np.diff(np.array(recent), axis=0) if len(recent) > LEAST_STEPS else np.zeros((0, 3))
