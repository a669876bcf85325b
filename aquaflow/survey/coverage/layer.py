"""One grid and the keyframes that are counted in it, each with the pose that it was counted by."""

from __future__ import annotations

from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.footprint import Footprint
from aquaflow.survey.coverage.raster import GridFrame, cells_seen
from aquaflow.survey.coverage.tiles import Tiles

Sight = tuple[Footprint, Sim3]
"""A footprint and T_mc."""


class CoverageLayer:
    """Counts that are at any time those of the keyframes in ``drawn``, whatever came before."""

    def __init__(self, frame: GridFrame) -> None:
        self.frame = frame
        self.tiles = Tiles()
        self.drawn: dict[int, Sight] = {}
        """By the keyframe's number."""

    def draw(self, number: int, seen: Sight | None) -> None:
        """Count a keyframe as ``seen``, in place of how it was counted; None: no more."""
        before = self.drawn.pop(number, None)
        if before is not None:
            self.tiles.remove(cells_seen(*before, self.frame))
        if seen is not None:
            self.tiles.add(cells_seen(*seen, self.frame))
            self.drawn[number] = seen
