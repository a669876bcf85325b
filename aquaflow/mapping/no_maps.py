"""The maps of a dive that is only tracked: none, and nothing of them is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.base.clocks.wall import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Profiler
from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.work import Growth, Insertion, Progress

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.render.views import View


class NoMaps:
    """An :class:`aquaflow.mapping.work.OwnedMaps` that never has a map."""

    renderer = None

    def __init__(self, profiler: Profiler, failures: Failures) -> None:
        self.profiler, self.failures = profiler, failures
        self.mappers: dict[int, Mapper] = {}
        self.held_out: dict[int, list[View]] = {}
        self.lost_pictures: set[int] = set()

    def grow(self, growth: Growth) -> None:
        """Nothing grows."""

    def hold_out(self, view: View, sub_map: int) -> None:
        """There is nothing to hold a view against."""

    def insert(self, insertion: Insertion) -> None:
        """Nothing is inserted."""

    def optimise(self, sub_map: int, steps: int) -> None:
        """There is nothing to optimise."""

    def correct(self, moves: Mapping[int, Sim3], merged: Mapping[int, int]) -> None:
        """Nothing moves with its keyframe."""

    def refine(self, progress: Progress | None = None, until: Deadline | None = None) -> None:
        """There is nothing to refine."""

    def leave_device(self, why: str) -> bool:
        return False

    def holds(self, view: View) -> bool:
        return False

    def give_back_memory(self) -> None:
        """No device has anything of it."""

    def usable_memory(self) -> float | None:
        return None

    def save_pictures(self) -> list[Path]:
        return []

    def serialise(self) -> tuple[dict[str, Any], Arrays]:
        return {"maps": {}, "held_out": {}}, {}

    def restore(
        self,
        facts: dict[str, Any],
        arrays: Arrays,  # as from serialise
    ) -> None:
        """A dive without maps has none in its checkpoint."""

    def close(self, keep: bool = False) -> None:
        """There are no files."""
