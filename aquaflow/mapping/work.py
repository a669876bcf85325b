"""What tracking asks of the maps, and what the maps are to those who own them; without torch.

Everything else in ``mapping`` loads torch, 100 MB that a dive without a map does not need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Profiler
from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.render.contract import Renderer
    from aquaflow.render.views import View

MIN_VIEWS = 3
"""Fewer posed frames are not a map, and not worth refining."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Insertion:
    """A view and the depths of its pixels."""

    view: View
    sub_map: int
    pointmap: Pointmap
    base: Mapping[Path, Sim3] = field(default_factory=dict)
    """Map files of the earlier dive that this one was recognised in, each with T_mb from its world
    to the sub-map's; of those that show the same the first counts."""


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
    base: Mapping[Path, Sim3] = field(default_factory=dict)
    """As of an :class:`Insertion`, for ``pointmap``."""


class MapWork(Protocol):
    """Tracking's requests to the maps; done at once, or in a thread."""

    @property
    def mappers(self) -> dict[int, Mapper]:
        """The mappers by sub-map. Owned by the mapping thread while it runs."""
        ...

    @property
    def renderer(self) -> Renderer | None:
        """What the maps are drawn with at the moment, and where; None without maps."""
        ...

    @property
    def held_out(self) -> dict[int, list[View]]:
        """Per sub-map, the views that were tracked but never mapped."""
        ...

    @property
    def taken_over(self) -> int:
        """Gaussians that came from the maps of an earlier dive."""
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

    def carry(self, keyframe: int, carried: Callable[[Sim3], Sim3]) -> None:
        """Give the views of a keyframe whose depths were solved again the poses that go with them,
        from T_wc to T_wc; the optimiser moves the Gaussians."""
        ...

    def refine(self, progress: Progress | None = None, until: Deadline | None = None) -> None:
        """After the last frame, as far as there is time; the caller owns the maps from here on."""
        ...

    def leave_device(self, why: str) -> bool:
        """After ``refine``: the maps go on on the CPU, if they are not there; True if they were
        elsewhere. They are as their device has them, or, if it is gone, as they were refined."""
        ...

    def close(self, keep: bool = False) -> None:
        """Remove the files of the work folder; or, to ``keep`` them, write the missing ones."""
        ...


class OwnedMaps(MapWork, Protocol):
    """The maps as the thread that owns them uses them."""

    profiler: Profiler
    failures: Failures

    def optimise(self, sub_map: int, steps: int) -> None:
        """Steps of the optimiser on a sub-map's map."""
        ...

    def holds(self, view: View) -> bool:
        """True if a map has the view, at its full size."""
        ...

    def give_back_memory(self) -> None:
        """Free what the maps' device can do without."""
        ...

    def usable_memory(self) -> float | None:
        """Share of the device's memory that new tensors may have, in [0, 1]; None on the CPU."""
        ...

    def save_pictures(self) -> list[Path]:
        """Write what pictures are only in memory; the files that are new."""
        ...

    @property
    def lost_pictures(self) -> set[int]:
        """Frame indices of the views that :meth:`restore` found no file of."""
        ...

    def serialise(self) -> tuple[dict[str, Any], Arrays]:
        """All maps for a checkpoint: facts for JSON, and arrays, which are copies."""
        ...

    def restore(
        self,
        facts: dict[str, Any],
        arrays: Arrays,  # as from serialise
    ) -> None:
        """Become, while new, as the serialised maps were; a view whose file was lost is left out.

        Raises:
            KeyError, ValueError, TypeError, RuntimeError: this is no such checkpoint.
        """
        ...


# --------------------------------------------------------------------------------------------------
# The maps of a dive that is only tracked: none, and nothing of them is loaded.


class NoMaps:
    """An :class:`aquaflow.mapping.work.OwnedMaps` that never has a map."""

    renderer = None
    taken_over = 0

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

    def carry(self, keyframe: int, carried: Callable[[Sim3], Sim3]) -> None:
        """No view has a pose."""

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
