"""``aquaflow export --format ply``, ``obj`` and ``glb``: the surface of a dive as triangles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, load
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import Placement
from aquaflow.dive.png import encoded_png
from aquaflow.dive.point_cloud import read_posed_views
from aquaflow.render.library import library_or_none
from aquaflow.survey.export.mesh.atlas import lay_out, paint
from aquaflow.survey.export.mesh.blocks import Blocks
from aquaflow.survey.export.mesh.glb import write_glb
from aquaflow.survey.export.mesh.placed_mesh import PlacedMesh, Texture
from aquaflow.survey.export.mesh.seen_places import batches, look_at, place_sigmas, shown_colours
from aquaflow.survey.export.mesh.surface import SurfaceBuilder, fuse, require_marching_cubes
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces, drawn_surfaces
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.export.ortho.grid import round_to_digits

Array = npt.NDArray[np.float64]
Kind = Literal["ply", "obj", "glb"]
Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""

VOXEL_PX = 2.0
"""Side of a voxel, in pixels of the mapped pictures at the median range."""
MOST_TRIANGLES = 2_000_000
"""About, where nobody asks for a resolution: half of a voxel's side squared each. The voxels of a
longer dive are wider, or it would have tens of millions, which few programs open."""
LEAST_VIEWS = 2
"""That show a place, or it is a hole: one view alone has no parallax. As in the ortho."""
MOST_SIGMA_PX = 8.0
"""Sigma of a vertex, from where rays meet, beyond which it is a hole, in widths of a pixel there:
two rays that cross at 10 degrees leave as much along them. What is seen from less apart is smears;
on the reef, which is filmed forwards, 11 and 18 leave much of the far ground."""
LEAST_PIECE_PX = 60.0
"""Side of the square whose area a piece of the surface has at least, in widths of a pixel at the
median range: what is smaller is haze or a fish, however coarse the mesh is wanted."""


@dataclass(frozen=True)
class WrittenMesh:
    """What was written."""

    files: dict[Kind, list[Path]]
    vertices: int
    triangles: int
    area: float
    """Of the surface, in its unit squared."""
    voxel: float
    """Side of a voxel, in the unit of the mesh."""
    sigma: float
    """Median of the vertices' sigmas, in the unit of the mesh."""
    texture: tuple[int, int] | None
    """Width and height, pixels."""
    where: Placement
    origin: tuple[float, float, float]
    seen: str


@dataclass(frozen=True)
class FusedSurface:
    """A mesh with what its views say, in their frame."""

    mesh: TriangleMesh
    sigma: Array
    """[N] of the vertices: :func:`aquaflow.survey.export.mesh.seen_places.place_sigmas`."""
    views: ViewSurfaces
    voxel: float
    """Side of a voxel."""


def export_mesh(
    dive: Dive,
    targets: Mapping[Kind, Path],
    resolution: float | None = None,
    water: bool = False,
    progress: Progress | None = None,
) -> WrittenMesh:
    """Write the surface of the dive's largest sub-map, to the file that each of ``targets`` names;
    of ``obj`` also .mtl and .png beside it.

    Args:
        resolution: side of a voxel, m, or map units where the dive has no metres; None: two pixels
            of the mapped pictures at their median range, wider from MOST_TRIANGLES on.
        water: with the water, as seen from the views' median range.

    Raises:
        InputError: a library is missing, the dive has no map, no views or no surface, there would
            be too many voxels, or a file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    require_marching_cubes()
    if targets.keys() != {"ply"}:
        load("xatlas", "a textured mesh", "survey")
    mapper, frame = dive.map(), dive.frame
    posed, where = read_posed_views(dive, mapper.views)
    if len(mapper.gaussians) == 0:
        raise InputError(f"the map of {dive} is empty; map a recording that shows more")
    scale, report = frame.T_nm.scale, progress or _nothing
    drawn = drawn_surfaces(mapper, scale)
    views = ViewSurfaces(
        posed, drawn, next(iter(targets.values())).parent, partial(report, "views")
    )
    surface = fused_surface(views, resolution or _usual_voxel(views), report)
    through = views.median_range if water and mapper.medium.active else None
    colours = Colours(mapper, scale, through)

    def colour(
        places: Array,  # [M, 3]
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        return shown_colours(colours, look_at(views, places, surface.voxel, library_or_none()))

    seen = "without water" if through is None else f"through {through:.3g} {where.unit} of water"
    placed = _place_mesh(surface, where, seen)
    files = {kind: [path] for kind, path in targets.items()}
    texture = None
    if targets.keys() != {"ply"}:
        layout = lay_out(surface.mesh, surface.voxel / VOXEL_PX)
        texture = Texture(layout, paint(surface.mesh, layout, colour, partial(report, "texture")))
    for kind, path in targets.items():
        if texture is not None and kind == "obj":
            files[kind] = write_obj(path, placed, texture)
        elif texture is not None and kind == "glb":
            write_glb(path, placed, texture)
        else:
            vertices = surface.mesh.vertices
            found = [colour(vertices[part])[0] for part in batches(len(vertices))]
            write_mesh_ply(path, placed, np.concatenate(found))
    size = None if texture is None else (texture.layout.width, texture.layout.height)
    return WrittenMesh(
        files, len(surface.mesh.vertices), len(surface.mesh.faces), surface.mesh.area(),
        surface.voxel, float(np.median(surface.sigma)), size, where, placed.origin, seen,
    )  # fmt: skip


def _usual_voxel(views: ViewSurfaces) -> float:
    """Side of a voxel where nobody asks for one."""
    finest = VOXEL_PX * views.footprint
    return round_to_digits(max(finest, math.sqrt(2.0 * views.area / MOST_TRIANGLES)))


def _nothing(what: str, done: int, total: int) -> None:
    """No progress is shown."""


def fused_surface(views: ViewSurfaces, voxel: float, report: Progress) -> FusedSurface:
    """The fused surface without what too few views agree on, and without small pieces.

    Raises:
        InputError: scikit-image is missing, or nothing is left.
    """
    blocks = Blocks(views, voxel, partial(report, "blocks"))
    builder = SurfaceBuilder(voxel)
    library = library_or_none()
    for done, chunk in enumerate(blocks.chunks()):
        builder.add(chunk, fuse(views, chunk, voxel, LEAST_VIEWS, library))
        report("fusion", done + 1, blocks.chunk_count())
    mesh = builder.mesh()
    sigma, sigma_px = _vertex_sigmas(views, mesh, voxel)
    mesh, kept = mesh.with_faces(np.asarray((sigma_px <= MOST_SIGMA_PX)[mesh.faces].all(axis=1)))
    sigma = sigma[kept]
    mesh, kept = mesh.without_small_pieces((LEAST_PIECE_PX * views.footprint) ** 2)
    if not len(mesh.faces):
        raise InputError(
            "too little of the map is seen well by two views to make a surface of it; give a "
            "larger --resolution, or map a recording that shows more"
        )
    return FusedSurface(mesh, sigma[kept], views, voxel)


def _vertex_sigmas(views: ViewSurfaces, mesh: TriangleMesh, voxel: float) -> tuple[Array, Array]:
    """[N] :func:`place_sigmas` of the vertices."""
    parts = [
        np.stack(place_sigmas(views, mesh.vertices[part], voxel, library_or_none()))
        for part in batches(len(mesh.vertices))
    ]
    sigma, sigma_px = np.concatenate([np.empty((2, 0)), *parts], axis=1)
    return sigma, sigma_px


def _place_mesh(surface: FusedSurface, where: Placement, seen: str) -> PlacedMesh:
    """The mesh in the coordinates that it is written in."""
    origin = np.zeros(3)
    if where.epsg is not None:
        origin = np.round(where.on_grid(np.zeros((1, 3)))[0])
    return PlacedMesh(
        where.on_grid(surface.mesh.vertices) - origin,
        where.turned_to_grid(surface.mesh.normals()),
        surface.mesh.faces,
        surface.sigma,
        (float(origin[0]), float(origin[1]), float(origin[2])),
        where,
        seen,
    )


# --------------------------------------------------------------------------------------------------
# Meshes as PLY files: triangles with normals, colours and sigmas at the vertices.
#
# Format: G. Turk, "The PLY Polygon File Format" (1994); binary little-endian.

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


# --------------------------------------------------------------------------------------------------
# Meshes as Wavefront OBJ files with their material and texture beside them.
#
# Format: Wavefront Technologies, "Advanced Visualizer Manual", appendix B (OBJ) and MTL; numbers
# start at 1, and v of a texture starts at the bottom.

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
    yield from _format_rows("v %.5f %.5f %.5f\n", mesh.positions)
    yield from _format_rows("vt %.6f %.6f\n", upwards)
    yield from _format_rows("vn %.4f %.4f %.4f\n", mesh.normals)
    yield f"usemtl {MATERIAL}\ns 1\n"
    corners = layout.source[layout.faces] + 1, layout.faces + 1
    table = np.stack([corners[0], corners[1], corners[0]], axis=-1).reshape(len(mesh.faces), 9)
    yield from _format_rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", table)


def _format_rows(
    line: str,
    values: npt.NDArray[np.generic],  # [N, C]
) -> Iterator[str]:
    """Lines of all rows, many at a time."""
    for first in range(0, len(values), LINES):
        part = values[first : first + LINES]
        yield line * len(part) % tuple(part.ravel().tolist())
