"""Triangles where the distance is zero: marching cubes, chunk by chunk, without seams.

T. Lewiner et al., "Efficient Implementation of Marching Cubes' Cases with Topological Guarantees"
(2003), as scikit-image has it. A vertex lies on an edge between two voxels, and is known by it, so
that chunks meet in the same vertices. A cell one of whose corners is unknown has no triangles: a
hole stays a hole.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import load
from aquaflow.render.library import Library
from aquaflow.survey.export.mesh.blocks import BLOCK, CHUNK_BLOCKS, Chunk
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import (
    COSINE,
    RANGE,
    SIGMA,
    NativeSurface,
    ViewSurfaces,
    truncation,
)

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


# --------------------------------------------------------------------------------------------------
# Ranges of all views, fused: the signed distance of voxels from the surface.
#
# B. Curless, M. Levoy, "A Volumetric Method for Building Complex Models from Range Images" (1996):
# every view says how far a voxel lies before the surface that it shows along its ray, cut off at a
# truncation; the weighted mean is zero on the surface. Here distances are across the surface and
# not along the ray, the truncation follows from the range's own sigma, and so does the weight. What
# lies further before the surface is free, and counts as such: haze between camera and ground is
# taken away by the views that look through it.

SLICE = 1 << 17
"""Voxels worked on at a time: 20 MB."""
LEAST_SHIFT = 1e-3
"""Voxels: distances nearer to 0 are moved to it, so that no vertex falls on a voxel."""


@dataclass(frozen=True)
class ChunkDistances:
    """The voxels of a chunk."""

    values: Array
    """[M] distance from the surface in voxels, positive where the cameras are; NaN of a voxel that
    too few views say anything of."""


def fuse(
    surfaces: ViewSurfaces,
    chunk: Chunk,
    voxel: float,
    least_views: int,
    library: Library | None = None,
) -> ChunkDistances:
    """Distances of ``chunk.voxels()``, each known to ``least_views`` views at least; with the
    compiled kernels of ``library``, or by numpy."""
    voxels = chunk.voxels()
    low, high = voxels.min(axis=0) * voxel, voxels.max(axis=0) * voxel
    numbers = surfaces.around(low, high)
    places = voxels.astype(np.float64) * voxel
    found = []
    for first in range(0, len(places), SLICE):
        sums = DistanceSums.of(places[first : first + SLICE])
        for number in numbers:
            if library is None:
                add_by_numpy(sums, surfaces, number, voxel)
            else:
                add_compiled(library, sums, surfaces, number, voxel)
        found.append(sums.distances(voxel, least_views))
    return ChunkDistances(np.concatenate(found))


@dataclass(frozen=True)
class DistanceSums:
    """What some views say of places."""

    places: Array
    """[M, 3] in the frame of the mesh."""
    total: Array
    """[M] sum of the distances from the views' surfaces, each times its weight."""
    weights: Array
    """[M] sum of the weights."""
    near: npt.NDArray[np.int32]
    """[M] number of views whose surface is near."""

    @staticmethod
    def of(
        places: Array,  # [M, 3]
    ) -> DistanceSums:
        """Of no view."""
        count = len(places)
        return DistanceSums(
            np.ascontiguousarray(places), np.zeros(count), np.zeros(count), np.zeros(count, "i4")
        )

    def distances(self, voxel: float, least_views: int) -> Array:
        """[M] weighted means in voxels; NaN where fewer than ``least_views`` surfaces are near."""
        known = self.near >= least_views
        values = np.full(len(self.places), np.nan)
        values[known] = self.total[known] / (self.weights[known] * voxel)
        tiny = np.abs(values) < LEAST_SHIFT
        values[tiny] = np.where(values[tiny] < 0.0, -LEAST_SHIFT, LEAST_SHIFT)
        return values


def add_by_numpy(sums: DistanceSums, surfaces: ViewSurfaces, number: int, voxel: float) -> None:
    """Add what one view says of the places, readable."""
    view, layers = surfaces.views[number], surfaces.surface(number)
    camera = view.camera
    local = (sums.places - view.T_uc.t) @ view.T_uc.R
    which = np.flatnonzero(local[:, 2] > voxel)
    local = local[which]
    u, v = camera.project(local).T - 0.5
    # Four pixels around each, of which the last row and column have none further on.
    inside = (u >= 0.0) & (u < camera.width - 1) & (v >= 0.0) & (v < camera.height - 1)
    which, local, u, v = which[inside], local[inside], u[inside], v[inside]
    column, row = u.astype(np.intp), v.astype(np.intp)
    ranges = _between(layers[RANGE], row, column, v - row, u - column)
    nearest = (v + 0.5).astype(np.intp), (u + 0.5).astype(np.intp)
    cosine, sigma = (layers[layer][nearest].astype(np.float64) for layer in (COSINE, SIGMA))
    distance = (ranges - np.linalg.norm(local, axis=1)) * cosine
    reach = truncation(sigma, voxel)
    with np.errstate(invalid="ignore"):
        told = (distance >= -reach) & (ranges < surfaces.far)
    which, distance, reach = which[told], distance[told], reach[told]
    weight = cosine[told] / sigma[told] ** 2
    sums.total[which] += weight * np.minimum(distance, reach)
    sums.weights[which] += weight
    sums.near[which] += distance <= reach


def _between(
    layer: npt.NDArray[np.float32],  # [H, W]
    row: npt.NDArray[np.intp],  # [K]
    column: npt.NDArray[np.intp],  # [K]
    down: Array,  # [K] in [0, 1), from the row on
    right: Array,  # [K] in [0, 1), from the column on
) -> Array:
    """[K] bilinear; NaN where one of the four pixels is."""
    top = layer[row, column] * (1.0 - right) + layer[row, column + 1] * right
    bottom = layer[row + 1, column] * (1.0 - right) + layer[row + 1, column + 1] * right
    return np.asarray(top * (1.0 - down) + bottom * down)


class _NativeFusion(ctypes.Structure):
    """``FuseRanges`` of native/fuse_ranges.h."""

    _fields_ = (
        ("view", NativeSurface),
        *((name, ctypes.c_void_p) for name in ("places", "total", "weights", "near")),
        ("count", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("nearest_z", "far")),
    )


def add_compiled(
    library: Library, sums: DistanceSums, surfaces: ViewSurfaces, number: int, voxel: float
) -> None:
    """As :func:`add_by_numpy`, in an eighth of its time (native/fuse_ranges.h)."""
    given = _NativeFusion(
        view=NativeSurface.of(surfaces, number, voxel),
        count=len(sums.places), nearest_z=voxel, far=surfaces.far,
    )  # fmt: skip
    for name in ("places", "total", "weights", "near"):
        setattr(given, name, getattr(sums, name).ctypes.data)
    library.call("aq_fuse_ranges", ctypes.byref(given))
