"""Which parts of space hold surface: cubes of voxels around what the views show.

Voxels are the points of a lattice whose spacing is the voxel's side. Blocks are cubes of 8 voxels a
side, chunks cubes of blocks. Chunks are worked on one after the other, so that memory does
not grow with the dive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces, truncation

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

BLOCK = 8
"""Voxels along a block: more than the widest truncation, so that a surface and the points at that
distance from it on either side meet every block that it needs."""
CHUNK_BLOCKS = 8
"""Blocks along a chunk: 65 x 65 x 65 voxels are 2 MB of float64."""
MOST_BLOCKS = 1 << 19
"""268 million voxels, of which some 30 million triangles come: more is a slip of the resolution."""
BITS = 21
"""Of each of three coordinates in one number."""
LARGEST = 1 << (BITS - 1)
STEPS = np.array([x << 2 * BITS | y << BITS | z for x in (0, 1) for y in (0, 1) for z in (0, 1)])
"""[8] from a block's number to those of the blocks behind it along any of the axes."""
STRIDE_PX = 2
"""Of the pixels that blocks are found by: what two voxels of the default side are apart."""


@dataclass(frozen=True)
class Chunk:
    """A cube of blocks."""

    corner: Integers
    """[3] its first voxel."""
    blocks: Integers
    """[B, 3] first voxels of the blocks in it, and of those that share its last layer."""

    def voxels(self) -> Integers:
        """[M, 3] all voxels of the blocks that lie in the chunk or in the layer after it."""
        steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
        voxels = (self.blocks[:, None] + steps.reshape(1, -1, 3)).reshape(-1, 3)
        side = CHUNK_BLOCKS * BLOCK
        return voxels[(voxels <= self.corner + side).all(axis=1)]


class Blocks:
    """The blocks around the surfaces of all views."""

    def __init__(
        self,
        surfaces: ViewSurfaces,
        voxel: float,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """``voxel``: side of a voxel in the mesh's unit.

        Raises:
            InputError: there would be too many.
        """
        keys, new = np.empty(0, np.int64), [np.empty(0, np.int64)]
        last = len(surfaces.views) - 1
        for number in range(last + 1):
            new.append(_touch(surfaces, number, voxel))
            # Joined when they are as many as those before: each view at once would be quadratic.
            if number == last or sum(map(len, new)) > len(keys):
                keys, new = _distinct(np.concatenate([keys, *new])), []
            if len(keys) > MOST_BLOCKS:
                raise InputError(
                    f"voxels of {voxel:g} would be more than {MOST_BLOCKS * BLOCK**3 // 10**6} "
                    "million; give a larger --resolution"
                )
            if progress is not None:
                progress(number + 1, len(surfaces.views))
        self._blocks = _unpack(keys)
        self._chunks = _distinct(_pack(self._blocks // CHUNK_BLOCKS))
        """Keys of the chunks that hold a block, ascending."""

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self._blocks)

    def chunks(self) -> Iterator[Chunk]:
        """Every chunk that holds a block, in a fixed order."""
        chunks, blocks = self._members()
        for chunk in _unpack(self._chunks):
            key = _pack(chunk[None])[0]
            first, last = np.searchsorted(chunks, (key, key + 1))
            corner = chunk * CHUNK_BLOCKS * BLOCK
            yield Chunk(corner, self._blocks[blocks[first:last]] * BLOCK)

    def _members(self) -> tuple[Integers, Integers]:
        """Keys of chunks, ascending, and the numbers of the blocks that belong to each: those in it
        and, in the layer after it, those of the chunks behind."""
        own = self._blocks // CHUNK_BLOCKS
        at_first = self._blocks % CHUNK_BLOCKS == 0
        chunks, blocks = [], []
        for back in np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
            numbers = np.flatnonzero((at_first | (back == 0)).all(axis=1))
            chunks.append(_pack(own[numbers] - back))
            blocks.append(numbers)
        keys, numbers = np.concatenate(chunks), np.concatenate(blocks)
        order = np.lexsort((numbers, keys))
        return keys[order], numbers[order]

    def chunk_count(self) -> int:
        """How many chunks there are."""
        return len(self._chunks)


def _touch(surfaces: ViewSurfaces, number: int, voxel: float) -> Integers:
    """Keys of the blocks within the truncation of what one view shows."""
    points, normals, sigmas = surfaces.points(number, STRIDE_PX)
    reach = truncation(sigmas, voxel)[:, None] * normals
    places = np.vstack([points - reach, points, points + reach]) / voxel
    if np.abs(places).max(initial=0.0) >= BLOCK * (LARGEST - 2):
        raise InputError(
            f"voxels of {voxel:g} are too small for a dive of this extent; give a larger "
            "--resolution"
        )
    # A surface that lies within a voxel of a block's side needs the block behind it, too.
    low = np.floor((places - 1.0) / BLOCK).astype(np.int64)
    behind = np.floor((places + 1.0) / BLOCK).astype(np.int64) - low
    keys, needed = _pack(low), behind @ (4, 2, 1)
    found = []
    for corners in range(8):
        own = _distinct(keys[needed == corners])
        steps = [step for step in range(8) if step & ~corners == 0]
        found += [own + STEPS[step] for step in steps]
    return _distinct(np.concatenate(found))


def _distinct(
    keys: Integers,  # [N]
) -> Integers:
    """[n] the different ones, ascending. NumPy's own function hashes integers since 2.3, which
    takes 45 times as long for 10^5 different ones (2.4.6)."""
    keys = np.sort(keys)
    new = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=new[1:])
    return keys[new]


def _pack(
    coordinates: Integers,  # [N, 3]
) -> Integers:
    """[N] numbers in whose order x comes first, then y, then z."""
    x, y, z = (coordinates + LARGEST).T
    return np.asarray((x << 2 * BITS) | (y << BITS) | z)


def _unpack(
    keys: Integers,  # [N]
) -> Integers:
    """[N, 3]"""
    mask = (1 << BITS) - 1
    return np.stack([keys >> 2 * BITS, keys >> BITS & mask, keys & mask], axis=1) - LARGEST
