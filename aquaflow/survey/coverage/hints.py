"""What a pilot could do better at the moment: slower, lower, nearer to the last line."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import CoverageConfig

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
