"""Counts of the cells of a plane without bounds, in tiles that exist where something was seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.survey.coverage.raster import DIRECTION_BINS, RANGE_BINS, KeyframeCells

Counts = npt.NDArray[np.uint16]
Sides = npt.NDArray[np.uint8]

TILE = 16
"""Cells along a side: what a picture shows."""
TILE_BYTES = TILE * TILE * (2 * RANGE_BINS + DIRECTION_BINS)
"""10 kB."""


@dataclass
class CoverageTile:
    """Keyframes that see each cell, counted twice."""

    by_range: Counts
    """[16, 16, 12] by the bin of the smallest range; first axis x, second axis y."""
    by_direction: Sides
    """[16, 16, 17] by the direction from which it was seen, modulo 256: whether a direction occurs
    is asked for, and 256 views of one direction are as good as none once in a dive of years."""
    keyframes: int = 0
    """That see any cell of it."""

    @staticmethod
    def empty() -> CoverageTile:
        """One that nothing sees."""
        shape = (TILE, TILE)
        return CoverageTile(
            np.zeros((*shape, RANGE_BINS), np.uint16), np.zeros((*shape, DIRECTION_BINS), np.uint8)
        )


@dataclass
class Tiles:
    """Tiles by their place; what was added can be taken out."""

    tiles: dict[tuple[int, int], CoverageTile] = field(default_factory=dict)

    def add(self, cells: KeyframeCells) -> None:
        """Count what one keyframe sees."""
        for place, inside in _by_tile(cells):
            tile = self.tiles.setdefault(place, CoverageTile.empty())
            tile.keyframes += 1
            self._count(tile, cells, inside, 1)

    def remove(self, cells: KeyframeCells) -> None:
        """Undo :meth:`add` of the same cells."""
        for place, inside in _by_tile(cells):
            tile = self.tiles[place]
            tile.keyframes -= 1
            if tile.keyframes == 0:
                del self.tiles[place]
            else:
                self._count(tile, cells, inside, -1)

    @staticmethod
    def _count(
        tile: CoverageTile,
        cells: KeyframeCells,
        inside: npt.NDArray[np.bool_],  # [M]
        by: int,
    ) -> None:
        x, y = (cells.ij[inside] % TILE).T
        # No cell is there twice, so that nothing is lost where a place is indexed.
        tile.by_range[x, y, cells.range_bin[inside]] += np.uint16(by % (1 << 16))
        tile.by_direction[x, y, cells.direction_bin[inside]] += np.uint8(by % (1 << 8))

    def __len__(self) -> int:
        return len(self.tiles)

    @property
    def nbytes(self) -> int:
        """Of all counts."""
        return len(self.tiles) * TILE_BYTES


def _by_tile(cells: KeyframeCells) -> Iterator[tuple[tuple[int, int], npt.NDArray[np.bool_]]]:
    """Each tile that holds some of the cells, and which of them [M]."""
    places = cells.ij // TILE
    for x, y in sorted({(int(x), int(y)) for x, y in places}):
        yield (x, y), (places == (x, y)).all(axis=1)
