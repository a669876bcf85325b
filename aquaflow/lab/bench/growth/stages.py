"""CPU time of the parts of a frame's way, in each tenth of a dive."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from aquaflow.dive.run import DiveRun
from aquaflow.lab.bench.memory import resident_mb

TRACKING = ("prepare", "overlay", "gate", "track", "record")
MAPPING = ("view", "insert", "optimise")
GRAPH = ("graph", "correct")
"""Stages of the profiler; the graph has all that other threads spend as well."""
TENTHS = 10
"""Parts of a dive that are looked at."""


Tenth = dict[str, float | None]
"""``tracking_ms``, ``mapping_ms`` and ``graph_ms``, means over the frames of a tenth; at its end
``frames``, ``keyframes``, ``gaussians`` and ``resident_mb`` (None where unknown)."""


@dataclass(frozen=True)
class _Spent:
    """Milliseconds of CPU time since the start."""

    process: float
    thread: float
    stages: Mapping[str, float]

    @staticmethod
    def now(run: DiveRun) -> _Spent:
        return _Spent(1e3 * time.process_time(), 1e3 * time.thread_time(), run.profiler.totals_ms())


class TenthsMeter:
    """Looks at a run after every tenth of its frames; its profiler has the thread's clock."""

    def __init__(self, run: DiveRun, frames: int) -> None:
        self.tenths: list[Tenth] = []
        self._run, self._frames = run, frames
        self._done, self._last, self._before = 0, 0, _Spent.now(run)

    def frame_done(self) -> None:
        """Count a frame."""
        self._done += 1
        if self._done * TENTHS >= (len(self.tenths) + 1) * self._frames:
            self.tenths.append(self._tenth())

    def _tenth(self) -> Tenth:
        spent, before, count = _Spent.now(self._run), self._before, self._done - self._last
        self._before, self._last = spent, self._done

        def mean_ms(stages: tuple[str, ...]) -> float:
            of = [spent.stages.get(name, 0.0) - before.stages.get(name, 0.0) for name in stages]
            return sum(of) / count

        elsewhere = (spent.process - before.process) - (spent.thread - before.thread)
        elsewhere = max(elsewhere, 0.0)  # two clocks are read one after the other
        slam = self._run.slam
        return {
            "frames": self._done,
            "tracking_ms": round(mean_ms(TRACKING), 3),
            "mapping_ms": round(mean_ms(MAPPING), 3),
            "graph_ms": round(mean_ms(GRAPH) + elsewhere / count, 3),
            "keyframes": len(slam.keyframes),
            "gaussians": sum(len(mapper.gaussians) for mapper in slam.mappers.values()),
            "resident_mb": resident_mb(),
        }
