"""A mesh of triangles, its normals, and its pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles, counter-clockwise when seen from outside."""

    vertices: Array
    """[N, 3]"""
    faces: Integers
    """[M, 3] numbers of vertices."""

    def face_vectors(self) -> Array:
        """[M, 3] along the triangles' normals, twice their area long."""
        a, b, c = (self.vertices[corner] for corner in self.faces.T)
        return np.asarray(np.cross(b - a, c - a))

    def area(self) -> float:
        """Area of all triangles."""
        return float(0.5 * np.linalg.norm(self.face_vectors(), axis=1).sum())

    def normals(self) -> Array:
        """[N, 3] unit, the mean of the triangles around each vertex, weighted by their areas."""
        vectors = self.face_vectors()
        count = len(self.vertices)
        total = np.column_stack(
            [
                sum(np.bincount(corner, vector, count) for corner in self.faces.T)
                for vector in vectors.T
            ]
        )
        length = np.linalg.norm(total, axis=1, keepdims=True)
        # Where triangles fold back on each other none is right; up is as good as any.
        return np.where(length > 0.0, total / np.maximum(length, 1e-300), (0.0, 0.0, 1.0))

    def without_small_pieces(self, least_area: float) -> tuple[TriangleMesh, Integers]:
        """The pieces, connected by vertices, that have this area at least; and which vertices."""
        if not len(self.faces):
            return self, np.arange(len(self.vertices))
        a, b, c = self.faces.T
        ends = np.concatenate([a, b]), np.concatenate([b, c])
        count = len(self.vertices)
        graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(count, count))
        _, piece = connected_components(graph, directed=False)
        areas = np.bincount(piece[a], 0.5 * np.linalg.norm(self.face_vectors(), axis=1))
        return self.with_faces(areas[piece[a]] >= least_area)

    def with_faces(
        self,
        kept: npt.NDArray[np.bool_],  # [M]
    ) -> tuple[TriangleMesh, Integers]:
        """Some of the triangles with the vertices that they use, and the numbers of these here."""
        used, faces = np.unique(self.faces[kept], return_inverse=True)
        return TriangleMesh(self.vertices[used], faces.reshape(-1, 3)), used
