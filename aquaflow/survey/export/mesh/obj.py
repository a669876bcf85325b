"""Meshes as Wavefront OBJ files with their material and texture beside them.

Format: Wavefront Technologies, "Advanced Visualizer Manual", appendix B (OBJ) and MTL; numbers
start at 1, and v of a texture starts at the bottom.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.png import encoded_png
from aquaflow.survey.export.mesh.placed_mesh import PlacedMesh, Texture

LINES = 1 << 16
"""Lines that are formatted at a time."""
MATERIAL = "surface"
"""Its name in both files."""


def write_obj(path: Path, mesh: PlacedMesh, texture: Texture) -> list[Path]:
    """Write the mesh, and beside it its material (.mtl) and texture (.png); returns all three. Each
    is whole or not there, and the mesh is there last.

    Raises:
        InputError: a file cannot be written.
    """
    material, picture = path.with_suffix(".mtl"), path.with_suffix(".png")
    png = encoded_png(texture.picture)
    with (
        atomic_write(path) as obj,
        atomic_write(material) as mtl,
        atomic_write(picture) as image,
    ):
        image.write(png)
        # Its light is in the picture: no shading, no highlights.
        mtl.write(
            f"newmtl {MATERIAL}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\n"
            f"map_Ka {picture.name}\nmap_Kd {picture.name}\n".encode()
        )
        for text in _lines(mesh, texture, material.name):
            obj.write(text.encode())
        for stream in (obj, mtl, image):
            stream.flush()
        path.unlink(missing_ok=True)  # an earlier mesh has another texture
    return [path, material, picture]


def _lines(mesh: PlacedMesh, texture: Texture, material: str) -> Iterator[str]:
    yield "".join(f"# {line}\n" for line in mesh.comments())
    yield f"mtllib {material}\no {MATERIAL}\n"
    layout = texture.layout
    upwards = layout.uv() * (1.0, -1.0) + (0.0, 1.0)
    yield from _formatted("v %.5f %.5f %.5f\n", mesh.positions)
    yield from _formatted("vt %.6f %.6f\n", upwards)
    yield from _formatted("vn %.4f %.4f %.4f\n", mesh.normals)
    yield f"usemtl {MATERIAL}\ns 1\n"
    corners = layout.source[layout.faces] + 1, layout.faces + 1
    table = np.stack([corners[0], corners[1], corners[0]], axis=-1).reshape(len(mesh.faces), 9)
    yield from _formatted("f %d/%d/%d %d/%d/%d %d/%d/%d\n", table)


def _formatted(
    line: str,
    values: npt.NDArray[np.generic],  # [N, C]
) -> Iterator[str]:
    """Lines of all rows, many at a time."""
    for first in range(0, len(values), LINES):
        part = values[first : first + LINES]
        yield line * len(part) % tuple(part.ravel().tolist())
