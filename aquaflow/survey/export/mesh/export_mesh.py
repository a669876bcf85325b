"""``aquaflow export --format ply``, ``obj`` and ``glb``: the surface of a dive as triangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.extra import load
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import Placement
from aquaflow.dive.posed_views import read_posed_views
from aquaflow.survey.export.mesh.atlas import lay_out, painted
from aquaflow.survey.export.mesh.blocks import Blocks
from aquaflow.survey.export.mesh.colouring import batches, look_at, shown_colours
from aquaflow.survey.export.mesh.fusion import fused
from aquaflow.survey.export.mesh.glb import write_glb
from aquaflow.survey.export.mesh.mesh_ply import write_mesh_ply
from aquaflow.survey.export.mesh.obj import write_obj
from aquaflow.survey.export.mesh.placed_mesh import PlacedMesh, Texture
from aquaflow.survey.export.mesh.surface import SurfaceBuilder, require_marching_cubes
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces, drawn_surfaces
from aquaflow.survey.export.ortho.colours import Colours
from aquaflow.survey.export.ortho.grid import rounded

Array = npt.NDArray[np.float64]
Kind = Literal["ply", "obj", "glb"]
Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""

VOXEL_PX = 2.0
"""Side of a voxel, in pixels of the mapped pictures at the median range."""
LEAST_VIEWS = 2
"""That show a place, or it is a hole: one view alone has no parallax. As in the ortho."""
MOST_SIGMA_PX = 8.0
"""Sigma of a vertex, from where rays meet, beyond which it is a hole, in widths of a pixel there:
two rays that cross at 10 degrees leave as much along them. What is seen from less apart is smears;
on the reef, which is filmed forwards, 11 and 18 leave much of the far ground."""
LEAST_PIECE_VOXELS = 30.0
"""Side of the square whose area a piece of the surface has at least; what is smaller is haze or a
fish."""


@dataclass(frozen=True)
class WrittenMesh:
    """What was written."""

    files: list[Path]
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
    """[N] of the vertices: :class:`aquaflow.survey.export.mesh.colouring.Seen`."""
    views: ViewSurfaces
    voxel: float
    """Side of a voxel."""


def export_mesh(
    dive: Dive,
    path: Path,
    kind: Kind,
    resolution: float | None = None,
    water: bool = False,
    progress: Progress | None = None,
) -> WrittenMesh:
    """Write the surface of the dive's largest sub-map; of ``obj`` also .mtl and .png beside it.

    Args:
        resolution: side of a voxel, m, or map units where the dive has no metres; None: two pixels
            of the mapped pictures at their median range.
        water: with the water, as seen from the views' median range.

    Raises:
        InputError: a library is missing, the dive has no map, no views or no surface, there would
            be too many voxels, or a file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    require_marching_cubes()
    if kind != "ply":
        load("xatlas", "a textured mesh", "survey")
    mapper, frame = dive.map(), dive.frame
    posed, where = read_posed_views(dive, mapper)
    if len(mapper.gaussians) == 0:
        raise InputError(f"the map of {dive} is empty; map a recording that shows more")
    scale, report = frame.T_nm.scale, progress or _nothing
    drawn = drawn_surfaces(mapper, scale)
    views = ViewSurfaces(posed, drawn, path.parent, partial(report, "views"))
    surface = fused_surface(views, resolution or rounded(VOXEL_PX * views.footprint), report)
    through = views.median_range if water and mapper.medium.active else None
    colours = Colours(mapper, scale, through)

    def colour(
        places: Array,  # [M, 3]
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        return shown_colours(colours, look_at(views, places, surface.voxel))

    seen = "without water" if through is None else f"through {through:.3g} {where.unit} of water"
    placed = _placed(surface, where, seen)
    if kind == "ply":
        vertices = surface.mesh.vertices
        found = [colour(vertices[part])[0] for part in batches(len(vertices))]
        write_mesh_ply(path, placed, np.concatenate(found))
        files, size = [path], None
    else:
        layout = lay_out(surface.mesh, surface.voxel / VOXEL_PX)
        picture = painted(surface.mesh, layout, colour, partial(report, "texture"))
        texture, size = Texture(layout, picture), (layout.width, layout.height)
        files = [path]
        if kind == "obj":
            files = write_obj(path, placed, texture)
        else:
            write_glb(path, placed, texture)
    return WrittenMesh(
        files, len(surface.mesh.vertices), len(surface.mesh.faces), surface.mesh.area(),
        surface.voxel, float(np.median(surface.sigma)), size, where, placed.origin, seen,
    )  # fmt: skip


def _nothing(what: str, done: int, total: int) -> None:
    """No progress is shown."""


def fused_surface(views: ViewSurfaces, voxel: float, report: Progress) -> FusedSurface:
    """The fused surface without what too few views agree on, and without small pieces.

    Raises:
        InputError: scikit-image is missing, or nothing is left.
    """
    blocks = Blocks(views, voxel, partial(report, "blocks"))
    builder = SurfaceBuilder(voxel)
    for done, chunk in enumerate(blocks.chunks()):
        builder.add(chunk, fused(views, chunk, voxel, LEAST_VIEWS))
        report("fusion", done + 1, blocks.chunk_count())
    mesh = builder.mesh()
    known = _sigmas(views, mesh, voxel, in_pixels=True) <= MOST_SIGMA_PX
    mesh = mesh.with_faces(np.asarray(known[mesh.faces].all(axis=1)))
    mesh = mesh.without_small_pieces((LEAST_PIECE_VOXELS * voxel) ** 2)
    if not len(mesh.faces):
        raise InputError(
            "too little of the map is seen well by two views to make a surface of it; give a "
            "larger --resolution, or map a recording that shows more"
        )
    return FusedSurface(mesh, _sigmas(views, mesh, voxel), views, voxel)


def _sigmas(
    views: ViewSurfaces, mesh: TriangleMesh, voxel: float, in_pixels: bool = False
) -> Array:
    """[N] of the vertices, in the mesh's unit, or in widths of a pixel there."""
    found = [np.empty(0)]
    for part in batches(len(mesh.vertices)):
        seen = look_at(views, mesh.vertices[part], voxel)
        found.append(seen.sigma_px if in_pixels else seen.sigma)
    return np.concatenate(found)


def _placed(surface: FusedSurface, where: Placement, seen: str) -> PlacedMesh:
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
