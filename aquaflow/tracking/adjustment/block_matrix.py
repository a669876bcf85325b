"""A sparse symmetric matrix of 7 x 7 blocks, one for each pair of poses, that sums are made in.

Where its blocks are is known before they are: so a sum over anchors needs no more than the blocks
themselves, where a list of all that is to be summed would be several times as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from aquaflow.tracking.adjustment.equations import AnchorMatches, Array, Index, Mask
from aquaflow.tracking.adjustment.links import Links

SIDE = 7
"""Of a block: the degrees of freedom of a similarity."""


@dataclass(frozen=True)
class BlockPattern:
    """Which pairs of F free poses have a block."""

    place: Index
    """[K] of every pose among the free ones; -1 for those that are held."""
    free: int
    """F"""
    keys: Index
    """[B] row times F plus column of every block, increasing."""

    @staticmethod
    def of(
        matches: Sequence[AnchorMatches],
        links: Links,
        free: Mask,  # [K]
    ) -> BlockPattern:
        """Poses that an anchor's points, or a link, bring together."""
        place, count = np.full(len(free), -1, dtype=np.intp), int(free.sum())
        place[free] = np.arange(count)
        groups = [place[each.places] for each in matches]
        groups += list(place[np.stack([links.a, links.b], axis=1)])
        keys = [_keys(group[group >= 0], count) for group in groups]
        found = np.unique(np.concatenate(keys)) if keys else np.zeros(0, np.intp)
        return BlockPattern(place, count, found)

    def zero(self) -> BlockSum:
        """A sum of nothing so far."""
        blocks = np.zeros((len(self.keys), SIDE, SIDE))
        return BlockSum(self, blocks, np.zeros(SIDE * self.free))


@dataclass(frozen=True)
class BlockSum:
    """Equations of the free poses, while parts are added."""

    pattern: BlockPattern
    blocks: Array
    """[B, 7, 7]"""
    gradient: Array
    """[7 F]"""

    def add(
        self,
        places: Index,  # [n] among the free poses, each once; -1 for those that are held
        H: Array,  # [7 n, 7 n]
        gradient: Array,  # [7 n]
    ) -> None:
        """Add the equations of some poses; what belongs to held ones is left out."""
        inside = np.flatnonzero(places >= 0)
        at = places[inside]
        count = len(places)
        parts = H.reshape(count, SIDE, count, SIDE).transpose(0, 2, 1, 3)
        where = np.searchsorted(self.pattern.keys, _keys(at, self.pattern.free))
        self.blocks[where] += parts[np.ix_(inside, inside)].reshape(-1, SIDE, SIDE)
        self.gradient.reshape(-1, SIDE)[at] += gradient.reshape(count, SIDE)[inside]

    def matrix(self) -> sparse.csc_matrix:
        """[7 F, 7 F]"""
        size, keys = SIDE * self.pattern.free, self.pattern.keys
        if len(keys) == 0:
            return sparse.csc_matrix((size, size))
        rows, columns = np.divmod(keys, self.pattern.free)
        starts = np.searchsorted(rows, np.arange(self.pattern.free + 1))
        return sparse.bsr_matrix((self.blocks, columns, starts), shape=(size, size)).tocsc()


def _keys(
    places: Index,  # [n] among the free poses
    free: int,
) -> Index:
    """[n n] of the blocks between them."""
    return np.asarray((places[:, None] * free + places).ravel())
