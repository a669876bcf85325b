"""The cells that a keyframe sees: from its footprint and its pose, and from nothing else.

Because the same footprint and pose always give the same cells, what a keyframe added to a grid can
be taken out of it again, exactly, when a loop closure moves the keyframe.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import MIN_DEPTH
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.footprint import Footprint

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

RANGE_BINS = 12
"""Ranges are counted in bins, so that another water asks for no new look at the keyframes."""
BIN_RATIO = 2.0**0.25
"""Of a bin's end to its start, 19 %: the attenuation of real water is known to about that."""
FIRST_BIN = 2.0**-1.25
"""End of the first bin, over the grid's reference range; the last begins at 2.4 times it."""
RINGS = np.tan(np.radians([10.0, 25.0, 40.0, 60.0]))
"""Tangents of the angles from the vertical between which directions of view differ: at 60 % overlap
along a path, neighbouring views of a place differ by about 10 degrees (judgement)."""
SIDES = 4
"""Of every ring; those of one ring begin in the middle of those of the next."""
DIRECTION_BINS = 1 + SIDES * len(RINGS)
"""Within the first angle it is from above, whatever the side."""
SAMPLE_SPACING = 0.5
"""Largest distance of two samples of a patch, in cells: each cell has four then, whose areas sum up
to its own. At 0.7 a third of them had one, of half a cell, and were lost."""
FINENESS = (2, 4, 8, 12)
"""Samples along a side of a patch. A larger patch, of a view along the ground, is left out: nothing
of it is seen well, and the work per keyframe stays bounded."""
LEAST_SHARE = 0.5
"""Of a cell's area that must be seen, or it is not: then areas are right on the average."""
OFFSET, SPAN = 1 << 30, 1 << 31
"""Two cell numbers in one number of 64 bits."""


@dataclass(frozen=True)
class GridFrame:
    """Where a grid lies: x right on the page, y up, z towards who looks at it; map units."""

    R_gm: Array
    """[3, 3] from the sub-map's world."""
    cell: float
    """Side of a cell, map units."""
    reference: float
    """Range that the bins are counted from, map units."""

    def bin_ends(self) -> Array:
        """[12] upper end of each bin of ranges, map units; the last one has none."""
        ends = self.reference * FIRST_BIN * BIN_RATIO ** np.arange(RANGE_BINS, dtype=np.float64)
        ends[-1] = np.inf
        return np.asarray(ends)


@dataclass(frozen=True)
class KeyframeCells:
    """What one keyframe adds to a grid."""

    ij: Numbers
    """[M, 2] numbers of different cells along x and y."""
    range_bin: Numbers
    """[M] of the smallest range."""
    direction_bin: Numbers
    """[M] of the direction from which it was seen there."""


def cells_seen(footprint: Footprint, T_mc: Sim3, frame: GridFrame) -> KeyframeCells:
    """The cells of which a keyframe sees at least half."""
    corners, _ = footprint.patches()
    T_gc = Sim3(frame.R_gm @ T_mc.R, frame.R_gm @ T_mc.t, T_mc.scale)
    points, areas = _samples(T_gc.apply(corners), frame.cell)
    if len(points) == 0:
        empty = np.zeros(0, np.int64)
        return KeyframeCells(np.zeros((0, 2), np.int64), empty, empty)
    offset = T_gc.t - points
    ranges = np.linalg.norm(offset, axis=1)
    ij = np.floor(points[:, :2] / frame.cell).astype(np.int64)
    key = (ij[:, 0] + OFFSET) * SPAN + ij[:, 1] + OFFSET
    order = np.lexsort((ranges, key))
    key, ordered = key[order], areas[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    enough = np.add.reduceat(ordered, first) >= LEAST_SHARE * frame.cell**2
    chosen = order[first[enough]]  # the nearest sample of each cell
    return KeyframeCells(
        ij[chosen], _range_bins(ranges[chosen], frame), direction_bins(offset[chosen])
    )


def _samples(
    corners: Array,  # [P, 4, 3] g
    cell: float,
) -> tuple[Array, Array]:
    """Points [M, 3] on the patches, denser than cells, and the plan area [M] of each."""
    across, down = corners[:, [1, 3]] - corners[:, [0, 2]], corners[:, 2:] - corners[:, :2]
    edges = np.linalg.norm(np.concatenate([across, down], axis=1)[..., :2], axis=2).max(axis=1)
    x, y = corners[:, 3, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 1, :2]
    areas = 0.5 * np.abs(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])
    points, shares, finer_than = [np.zeros((0, 3))], [np.zeros(0)], 0.0
    for count in FINENESS:
        limit = SAMPLE_SPACING * cell * count
        chosen = (edges > finer_than) & (edges <= limit)
        at = (np.arange(count) + 0.5) / count
        v, u = (each.ravel() for each in np.meshgrid(at, at, indexing="ij"))
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
        points.append((weights @ corners[chosen]).reshape(-1, 3))
        shares.append(np.repeat(areas[chosen] / count**2, count**2))
        finer_than = limit
    return np.concatenate(points), np.concatenate(shares)


def _range_bins(
    ranges: Array,  # [M] map units
    frame: GridFrame,
) -> Numbers:
    """[M]"""
    return np.searchsorted(frame.bin_ends()[:-1], ranges).astype(np.int64)


def direction_bins(
    offset: Array,  # [M, 3] from the place to the camera, g
) -> Numbers:
    """[M] below ``DIRECTION_BINS``. 0: from above; then ring by ring, the sides of each against the
    clock."""
    x, y, z = offset.T
    ring = np.searchsorted(RINGS, np.hypot(x, y) / np.maximum(np.abs(z), MIN_DEPTH))
    turn = np.arctan2(y, x) * (SIDES / (2.0 * np.pi)) + 0.5 * (1 + ring % 2)
    side = np.floor(turn).astype(np.int64) % SIDES
    return np.where(ring == 0, 0, 1 + SIDES * (ring - 1) + side)


# --------------------------------------------------------------------------------------------------
# Counts of the cells of a plane without bounds, in tiles that exist where something was seen.

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
        """Memory of all counts."""
        return len(self.tiles) * TILE_BYTES


def _by_tile(cells: KeyframeCells) -> Iterator[tuple[tuple[int, int], npt.NDArray[np.bool_]]]:
    """Each tile that holds some of the cells, and which of them [M]."""
    places = cells.ij // TILE
    for x, y in sorted({(int(x), int(y)) for x, y in places}):
        yield (x, y), (places == (x, y)).all(axis=1)
