"""Triangles where the distance is zero: marching cubes, chunk by chunk, without seams.

T. Lewiner et al., "Efficient Implementation of Marching Cubes' Cases with Topological Guarantees"
(2003), as scikit-image has it. A vertex lies on an edge between two voxels, and is known by it, so
that chunks meet in the same vertices. A cell one of whose corners is unknown has no triangles: a
hole stays a hole.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors.extra import load
from aquaflow.survey.export.mesh.blocks import BLOCK, CHUNK_BLOCKS, Chunk
from aquaflow.survey.export.mesh.fusion import ChunkDistances
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SIDE = CHUNK_BLOCKS * BLOCK + 1
"""Voxels along a chunk with the layer that it shares with the next."""


def require_marching_cubes() -> Any:
    """The module skimage.measure.

    Raises:
        InputError: scikit-image is not installed.
    """
    return load("skimage.measure", "a mesh", "survey")


class SurfaceBuilder:
    """Collects the triangles of chunks."""

    def __init__(self, voxel: float) -> None:
        """``voxel``: side of a voxel in the mesh's unit."""
        self._voxel = voxel
        self._keys: list[Integers] = []
        self._vertices: list[Array] = []
        self._faces: list[Integers] = []
        self._count = 0

    def add(self, chunk: Chunk, distances: ChunkDistances) -> None:
        """The triangles of a chunk."""
        volume = np.full((SIDE, SIDE, SIDE), np.nan)
        volume[tuple((chunk.voxels() - chunk.corner).T)] = distances.values
        vertices, faces = _triangles(volume)
        if len(faces):
            self._keys.append(_edges(vertices, chunk.corner))
            self._vertices.append(vertices + chunk.corner)
            self._faces.append(faces + self._count)
            self._count += len(vertices)

    def mesh(self) -> TriangleMesh:
        """All triangles, their sides towards the cameras; vertices of neighbours are one."""
        if not self._faces:
            return TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
        keys = np.concatenate(self._keys)
        _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        # In the order in which they came, which follows space.
        order = np.argsort(first)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        faces = place[merged.reshape(-1)][np.concatenate(self._faces)]
        whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        vertices = np.concatenate(self._vertices)[first[order]]
        return TriangleMesh(vertices * self._voxel, faces[whole])


def _triangles(
    volume: Array,  # [SIDE, SIDE, SIDE] distances, NaN where unknown
) -> tuple[Array, Integers]:
    """Vertices [N, 3] in voxels of the volume, and triangles [M, 3]."""
    known = np.isfinite(volume)
    inside = np.where(known, volume, 1.0)
    cells = np.zeros_like(known)
    # scikit-image asks the last corner of a cell.
    cells[1:, 1:, 1:] = _all_corners(known) & ~_all_corners(inside > 0) & ~_all_corners(inside < 0)
    if not cells.any():
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    found = require_marching_cubes().marching_cubes(
        inside.astype(np.float32), 0.0, mask=cells, gradient_direction="descent",
        allow_degenerate=False,
    )  # fmt: skip
    return found[0].astype(np.float64), found[1].astype(np.int64)


def _all_corners(
    voxels: npt.NDArray[np.bool_],  # [SIDE, SIDE, SIDE]
) -> npt.NDArray[np.bool_]:
    """[SIDE - 1, SIDE - 1, SIDE - 1] of cells, whether all their eight corners are True."""
    for axis in range(3):
        after, before = [slice(None)] * 3, [slice(None)] * 3
        after[axis], before[axis] = slice(1, None), slice(-1)
        voxels = voxels[tuple(after)] & voxels[tuple(before)]
    return voxels


def _edges(
    vertices: Array,  # [N, 3] in voxels of a chunk
    corner: Integers,  # [3] the chunk's first voxel
) -> Integers:
    """[N, 4] what a vertex is known by: the voxel that its edge begins at and the edge's axis; of
    a vertex within a cell, a number of its own."""
    lower = np.floor(vertices)
    between = vertices != lower
    axis = np.argmax(between, axis=1)
    own = between.sum(axis=1) != 1
    axis[own] = 3 + np.flatnonzero(own)
    return np.column_stack([lower.astype(np.int64) + corner, axis])
