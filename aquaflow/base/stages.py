"""Stages of a dive: each is timed, and what it raises costs that stage alone."""

from __future__ import annotations

import threading
import time
from array import array
from collections import defaultdict
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, NamedTuple, TypedDict

import numpy as np

from aquaflow.base.errors.failures import Contained, Failures

FAILING = {
    "correct": "correction of the map",
    "gate": "frame gate",
    "graph": "keyframe graph",
    "keep": "keeping of a picture",
    "look": "known lengths",
    "prepare": "preparation",
}
"""What a stage is called where its failures are counted; a stage that is not here has one name."""


class Stages:
    """``with stages("gate", frame.index):`` times the block and contains what it raises."""

    def __init__(self, profiler: Profiler | None = None, failures: Failures | None = None) -> None:
        self.profiler, self.failures = profiler or Profiler(), failures or Failures()

    def __call__(self, name: str, frame: int | None = None) -> StageRun:
        """One run of a stage, of the frame with this index. Exceptions that have their own way to
        the user come through, as from :meth:`Failures.contain`."""
        contained = self.failures.contain(FAILING.get(name, name), frame)
        return StageRun(self.profiler, name, contained)


class StageRun:
    """One run of a stage."""

    __slots__ = ("_contained", "_timed")

    def __init__(self, profiler: Profiler, name: str, contained: Contained) -> None:
        self._timed, self._contained = profiler.stage(name), contained

    def __enter__(self) -> Contained:
        self._timed.__enter__()
        return self._contained

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        try:
            return self._contained.__exit__(kind, error, traceback)
        finally:
            self._timed.__exit__()


# --------------------------------------------------------------------------------------------------
# Where the time goes: named stages, measured with a monotonic clock.


class StageTime(TypedDict):
    """Milliseconds that one stage took."""

    count: int
    total: float
    p50: float
    p95: float


class _Event(NamedTuple):
    """One run of a stage, for the trace; seconds on the profiler's clock."""

    name: str
    started_s: float
    ended_s: float
    thread: int
    depth: int


class _Nesting(threading.local):
    """How many stages this thread is inside of."""

    depth = 0


class Profiler:
    """Collects durations per stage; stages may nest, each counts its own wall time.

    With ``trace`` every single run of a stage is kept, for :meth:`chrome_trace`. A stage ends with
    a call of ``settle``, which may wait for a GPU: what it still works on is that stage's. Another
    ``clock`` (s), such as that of the thread's CPU time, makes all times its own.
    """

    def __init__(
        self,
        trace: bool = False,
        settle: Callable[[], None] = lambda: None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._settle = settle
        self._clock_s = clock or time.perf_counter
        self.top_level_s = 0.0
        """Time inside stages, what nests counted once; of the thread that made the profiler."""
        self._durations: dict[str, array[float]] = defaultdict(lambda: array("d"))
        self._totals_ms: dict[str, float] = defaultdict(float)
        self._events: list[_Event] | None = [] if trace else None
        self._nesting = _Nesting()
        self._owner = threading.get_ident()
        self._origin_s = self._clock_s()

    def stage(self, name: str) -> _Stage:
        """Measure the ``with`` block as one run of ``name``."""
        return _Stage(self, name)

    def summary(self) -> dict[str, StageTime]:
        """Per stage: how often, total, median and 95th percentile in milliseconds."""
        return {
            name: StageTime(
                count=len(values),
                total=round(float(np.sum(values)), 3),
                p50=round(float(np.percentile(values, 50)), 3),
                p95=round(float(np.percentile(values, 95)), 3),
            )
            for name, values in self._durations.items()
        }

    def totals_ms(self) -> dict[str, float]:
        """Milliseconds in each stage so far; cheap, and for any thread to ask."""
        return dict(self._totals_ms)

    def chrome_trace(self) -> dict[str, Any]:
        """The runs in Chrome's trace event format; times in microseconds since the start.

        ``depth`` among an event's arguments is 0 for a stage that is inside no other.
        """
        return {
            "displayTimeUnit": "ms",
            "traceEvents": [
                {
                    "name": event.name,
                    "cat": "stage",
                    "ph": "X",
                    "ts": round((event.started_s - self._origin_s) * 1e6, 3),
                    "dur": round((event.ended_s - event.started_s) * 1e6, 3),
                    "pid": 1,
                    "tid": event.thread,
                    "args": {"depth": event.depth},
                }
                for event in self._events or ()
            ],
        }

    def _enter(self) -> int:
        depth = self._nesting.depth
        self._nesting.depth = depth + 1
        return depth

    def _leave(self, name: str, started_s: float, depth: int) -> None:
        self._settle()
        ended_s = self._clock_s()
        self._nesting.depth = depth
        took_ms = (ended_s - started_s) * 1e3
        self._durations[name].append(took_ms)
        self._totals_ms[name] += took_ms
        thread = threading.get_ident()
        if depth == 0 and thread == self._owner:
            self.top_level_s += ended_s - started_s
        if self._events is not None:
            self._events.append(_Event(name, started_s, ended_s, thread, depth))


class _Stage:
    """One run of a stage; a class, because a generator's context costs several times as much."""

    __slots__ = ("_depth", "_name", "_profiler", "_started_s")

    def __init__(self, profiler: Profiler, name: str) -> None:
        self._profiler, self._name = profiler, name

    def __enter__(self) -> None:
        self._depth = self._profiler._enter()
        self._started_s = self._profiler._clock_s()

    def __exit__(self, *_: object) -> None:
        self._profiler._leave(self._name, self._started_s, self._depth)


def pace(
    frame_ms: Sequence[float], count: int, first_pose_s: float | None, wall_s: float
) -> dict[str, Any]:
    """Milliseconds per frame and seconds to the first pose.

    ``p50`` and ``p95`` are of one frame while frames come in, None where single frames were not
    timed; ``total`` is the whole run, refining included, over its ``count`` frames.
    """
    half, most = (
        round(float(np.percentile(frame_ms, q)), 3) if frame_ms else None for q in (50, 95)
    )
    return {
        "ms_per_frame": {"p50": half, "p95": most, "total": round(1e3 * wall_s / max(count, 1), 3)},
        "time_to_first_pose_s": None if first_pose_s is None else round(first_pose_s, 3),
    }
