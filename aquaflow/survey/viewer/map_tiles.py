"""A map that has more Gaussians than a browser shows at once: detail comes where the eye is.

A browser gets the BASE Gaussians that cover most of the whole map first (packing.py), which are a
picture from anywhere. The map is cut into tiles besides, boxes that together hold all of it; each
has all its Gaussians in parts, those that cover most first. A browser asks for the parts that make
a difference from where the eye is, shows them in place of the base's Gaussians in that box, and
lets go of others, so that it never has more than ``budget`` (client/tiles.js).
"""

from __future__ import annotations

import gzip
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.ply import PlyFile
from aquaflow.survey.viewer.packing import (
    FIRST_CHUNK,
    GZIP_LEVEL,
    PackedCode,
    columns_of,
    inner_box,
)
from aquaflow.survey.viewer.splats import Float, Levels, ViewerSplats, viewer_splats

Rows = npt.NDArray[np.intp]

BASE = 4 * FIRST_CHUNK
"""Gaussians of the base, 65,536: 1.1 MB, a second at 10 Mbit/s. Of five million on 1,500 m2 they
are 15 cm apart, two pixels of a picture of all of them."""
LEAST_BUDGET = 2 * BASE
"""Gaussians that a browser shows at once, from which on a map has tiles: half are left for them."""
MOST_IN_TILE = 1 << 15
"""0.5 MB, 0.4 s at 10 Mbit/s."""
FIRST_PART = 8
"""One of so many Gaussians of a tile is in its first part: neighbours lie nearer by the root of
what the base has of the tile over that, and those of the second part nearer by the root of 8."""
SAMPLE = 200_000
"""Gaussians by which the code of scales is chosen."""
DECIMALS = 4
"""Of a tile's numbers in the description: 200 bytes each."""
LEAST_SHARE = 0.05
"""Of what a tile covers in its first part, by which that grows at most."""


@dataclass(frozen=True)
class MapTile:
    """Neighbours within a box."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    """[3] of the box."""
    middle: npt.NDArray[np.float64]
    half: npt.NDArray[np.float64]
    """[3] of the box within which its places are uniform in the packed parts."""
    rows: Rows
    """[N] of the map, those that cover most first."""
    grown: float
    """Factor by which those of the first part grow while the others are missing."""

    @property
    def ends(self) -> tuple[int, ...]:
        """Where each part ends."""
        first = -(-len(self.rows) // FIRST_PART)
        return (first,) if first == len(self.rows) else (first, len(self.rows))


class MapTiles:
    """The tiles of a map, each part packed when it is asked for; the map is read from its file."""

    def __init__(
        self,
        file: PlyFile,
        means: Float,  # [N, 3]
        weight: Float,  # [N] what each covers; negative: not shown
        base: ViewerSplats,
        levels: Callable[[Float], dict[str, Levels]],  # of centres [M, 3]
        budget: int,
    ) -> None:
        """``base``: BASE Gaussians that cover most of all; ``budget``: most shown at once."""
        self._file, self._levels, self.budget = file, levels, budget
        self.base = base
        self._shown = weight >= 0.0
        rows = np.flatnonzero(self._shown)
        self._tiles = [_tile(means, weight, part) for part in _split(means, rows)]
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Number of tiles."""
        return len(self._tiles)

    @cached_property
    def code(self) -> PackedCode:
        """What bytes stand for, in the base and in all tiles."""
        some = np.flatnonzero(self._shown)[:: max(1, len(self._file) // SAMPLE)]
        return PackedCode.of(self.base, shown_rows(self._file, some))

    def description(self) -> dict[str, Any]:
        """What a browser needs to choose tiles and to read them."""
        return {"budget": self.budget, "list": [self._described(each) for each in self._tiles]}

    @staticmethod
    def _described(tile: MapTile) -> dict[str, Any]:
        return {
            "low": tile.low.round(DECIMALS).tolist(), "high": tile.high.round(DECIMALS).tolist(),
            "middle": tile.middle.tolist(), "half": tile.half.tolist(),
            "ends": tile.ends, "grown": round(tile.grown, 3),
        }  # fmt: skip

    def parts(self) -> Iterator[tuple[int, int]]:
        """Numbers of each tile and each of its parts."""
        return ((n, k) for n, tile in enumerate(self._tiles) for k in range(len(tile.ends)))

    def part(self, number: int, part: int) -> bytes | None:
        """Gzipped, as a chunk of the base, in the tile's own box; None if there is no such part."""
        if not (0 <= number < len(self._tiles) and 0 <= part < len(self._tiles[number].ends)):
            return None
        tile = self._tiles[number]
        first = tile.ends[part - 1] if part else 0
        with self._lock:  # one at a time is in memory
            rows = tile.rows[first : tile.ends[part]]
            shown = shown_rows(self._file, rows, levels=self._levels)
            code = self.code.in_box(tile.middle, tile.half)
            return gzip.compress(columns_of(shown, code), GZIP_LEVEL, mtime=0)


def shown_rows(
    file: PlyFile,
    rows: Rows,  # [M]
    grown: float = 1.0,
    levels: Callable[[Float], dict[str, Levels]] = lambda _: {},  # of centres [M, 3]
) -> ViewerSplats:
    """Finite Gaussians of a file, larger by a factor."""
    found = file.rows(rows)
    means, wxyz, scales, opacities, colours = (
        np.asarray(each, np.float32)
        for each in (found.means, found.wxyz, found.scales, found.opacities, found.colours)
    )
    return viewer_splats(means, wxyz, grown * scales, opacities, colours, levels(means))


def _tile(
    means: Float,  # [N, 3]
    weight: Float,  # [N]
    rows: Rows,  # [M]
) -> MapTile:
    places = means[rows]
    rows = rows[np.argsort(-weight[rows], kind="stable")]
    covered = np.cumsum(weight[rows], dtype=np.float64)
    first = -(-len(rows) // FIRST_PART)
    middle, half = inner_box(places)
    share = max(covered[first - 1] / max(covered[-1], 1e-12), LEAST_SHARE)
    return MapTile(
        places.min(axis=0).astype(np.float64), places.max(axis=0).astype(np.float64),
        np.round(middle, DECIMALS), np.maximum(np.round(half, DECIMALS), 10.0**-DECIMALS), rows,
        float(share) ** -0.5,
    )  # fmt: skip


def _split(
    means: Float,  # [N, 3]
    rows: Rows,  # [M]
) -> Iterator[Rows]:
    """``rows`` in groups of neighbours, by halves along the axis in which they are spread most."""
    if len(rows) <= MOST_IN_TILE:
        if len(rows):
            yield rows
        return
    places = means[rows]
    axis = int(np.argmax(places.std(axis=0)))
    order = np.argpartition(places[:, axis], len(rows) // 2)
    yield from _split(means, np.sort(rows[order[: len(rows) // 2]]))
    yield from _split(means, np.sort(rows[order[len(rows) // 2 :]]))
