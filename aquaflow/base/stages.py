"""Stages of a dive: each is timed, and what it raises costs that stage alone."""

from __future__ import annotations

from types import TracebackType

from aquaflow.base.errors.failures import Contained, Failures
from aquaflow.base.profiler import Profiler

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
