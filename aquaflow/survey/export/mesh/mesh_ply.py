"""Meshes as PLY files: triangles with normals, colours and sigmas at the vertices.

Format: G. Turk, "The PLY Polygon File Format" (1994); binary little-endian.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.export.mesh.placed_mesh import PlacedMesh

VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [("sigma", "<f4")]
)
FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
NAMES = {"<f4": "float", "|u1": "uchar"}
"""PLY's names of numpy's types."""


def write_mesh_ply(
    path: Path,
    mesh: PlacedMesh,
    colours: npt.NDArray[np.uint8],  # [N, 3] RGB
) -> None:
    """Write the mesh, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    vertices = np.zeros(len(mesh.positions), VERTEX)
    for names, values in ((("x", "y", "z"), mesh.positions), (("nx", "ny", "nz"), mesh.normals)):
        for name, column in zip(names, values.T, strict=True):
            vertices[name] = column
    for name, column in zip(("red", "green", "blue"), colours.T, strict=True):
        vertices[name] = column
    vertices["sigma"] = mesh.sigma
    faces = np.zeros(len(mesh.faces), FACE)
    faces["count"], faces["vertex_indices"] = 3, mesh.faces
    with atomic_write(path) as stream:
        stream.write("\n".join([*_header(mesh), ""]).encode("ascii", "replace"))
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())


def _header(mesh: PlacedMesh) -> list[str]:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in mesh.comments()]
    lines.append(f"element vertex {len(mesh.positions)}")
    for name in VERTEX.names or ():
        lines.append(f"property {NAMES[VERTEX[name].str]} {name}")
    lines.append(f"element face {len(mesh.faces)}")
    return [*lines, "property list uchar int vertex_indices", "end_header"]
