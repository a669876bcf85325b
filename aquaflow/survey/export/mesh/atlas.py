"""A texture for a mesh: its triangles laid out in a picture, whose pixels get their own colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import load
from aquaflow.render.transfers import checkpoint_in
from aquaflow.survey.export.mesh.blocks import truncation
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import COSINE, RANGE, SIGMA, ViewSurfaces
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.export.ortho.sightings import PICTURE_SIGMA_PX

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Colour = Callable[[Array], tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]]
"""RGB [M, 3] of places [M, 3], and which of them [M] have a colour."""

LARGEST_SIDE = 8192
"""Pixels of a texture: what any desktop's GPU takes (D3D 10 asks for it, OpenGL 4.1 for twice)."""
FILLED = 0.5
"""Share of a texture that triangles are expected to take; xatlas reaches 0.8 on the reef."""
GROUP = 2000
"""Triangles that are laid out together, neighbours in space: for 60 000 of the reef xatlas takes
1.8 s so, 8.5 s where all are one group, and finds as many charts."""
FACES = 1 << 14
"""Triangles whose pixels are found at a time."""
PADDING_PX = 2
"""Between charts, filled with the colours beside it: a viewer that blends neighbours, or halves the
picture once, takes in no background."""


@dataclass(frozen=True)
class AtlasLayout:
    """A mesh laid out in a picture. At seams a vertex has several places in it."""

    source: Integers
    """[K] number of the vertex of the mesh."""
    places: Array
    """[K, 2] where in the picture, pixels from its top left corner."""
    faces: Integers
    """[M, 3] triangles of the mesh in its order, by the K."""
    width: int
    height: int
    """Pixels."""

    def uv(self) -> Array:
        """[K, 2] in [0, 1], from the top left corner."""
        return np.asarray(self.places / (self.width, self.height))


def lay_out(mesh: TriangleMesh, texel: float) -> AtlasLayout:
    """``mesh`` with ``texel`` as the side of a pixel, larger if the texture would be too large.

    Raises:
        InputError: xatlas is not installed.
    """
    xatlas = load("xatlas", "a textured mesh", "survey")
    most = FILLED * LARGEST_SIDE**2
    texel = max(texel, math.sqrt(mesh.area() / most))
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.texels_per_unit, packing.padding = 1.0 / texel, PADDING_PX
    normals, used = mesh.normals().astype(np.float32), list[Integers]()
    origin = mesh.vertices.mean(axis=0)  # float32 resolves places near it
    for first in range(0, len(mesh.faces), GROUP):
        vertices, faces = np.unique(mesh.faces[first : first + GROUP], return_inverse=True)
        places = (mesh.vertices[vertices] - origin).astype(np.float32)
        atlas.add_mesh(places, faces.reshape(-1, 3).astype(np.uint32), normals[vertices])
        used.append(vertices)
    atlas.generate(xatlas.ChartOptions(), packing)
    groups = [atlas[number] for number in range(len(used))]
    starts = np.cumsum([0, *(len(source) for source, _, _ in groups)])
    source = [own[each] for own, (each, _, _) in zip(used, groups, strict=True)]
    corners = [each.astype(np.int64) + at for at, (_, each, _) in zip(starts, groups, strict=False)]
    size = np.array([atlas.width, atlas.height])
    places = np.concatenate([uv for _, _, uv in groups]) * size.astype(np.float64)
    return AtlasLayout(np.concatenate(source), places, np.concatenate(corners), *size.tolist())


def paint(
    mesh: TriangleMesh,
    layout: AtlasLayout,
    colour: Colour,
    progress: Callable[[int, int], None] | None = None,
) -> npt.NDArray[np.uint8]:
    """The picture [H, W, 3] RGB of the layout, whose pixels have the colours of their places, or
    those beside it where a place has none."""
    size = (layout.height, layout.width)
    picture, wanted = np.zeros((*size, 3), np.uint8), np.zeros(size, bool)
    painted = np.zeros(size, bool)
    for done, (rows, columns, places) in enumerate(_texels(mesh, layout)):
        wanted[rows, columns] = True
        for part in batches(len(places)):
            found, known = colour(places[part])
            own = rows[part][known], columns[part][known]
            picture[own], painted[own] = found[known], True
        if progress is not None:
            progress(done + 1, -(-len(mesh.faces) // FACES))
    steps = 0
    while painted.any() and (steps < PADDING_PX or (wanted & ~painted).any()):
        _grow(picture, painted)
        steps += 1
    return picture


def _texels(mesh: TriangleMesh, layout: AtlasLayout) -> Iterator[tuple[Integers, Integers, Array]]:
    """Rows, columns and places on the mesh of pixels, some triangles at a time: those that hold the
    middle of a triangle, which may hold no pixel's, and then those whose middle it holds."""
    for first in range(0, len(mesh.faces), FACES):
        part = slice(first, first + FACES)
        corners = layout.places[layout.faces[part]]
        low = np.floor(corners.min(axis=1)).astype(np.int64)
        sizes = np.ceil(corners.max(axis=1)).astype(np.int64) - low
        counts = sizes.prod(axis=1)
        face = np.repeat(np.arange(len(corners)), counts)
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        columns = low[face, 0] + within % sizes[face, 0]
        rows = low[face, 1] + within // sizes[face, 0]
        shares = _shares(corners[face], np.column_stack([columns, rows]) + 0.5)
        inside = (shares >= 0.0).all(axis=1)
        inside &= (rows < layout.height) & (columns < layout.width) & (rows >= 0) & (columns >= 0)
        vertices = mesh.vertices[layout.source[layout.faces[part]]]
        places = np.einsum("mc,mcx->mx", shares[inside], vertices[face[inside]])
        middle = np.floor(corners.mean(axis=1)).astype(np.int64)
        yield (
            np.concatenate([middle[:, 1], rows[inside]]),
            np.concatenate([middle[:, 0], columns[inside]]),
            np.concatenate([vertices.mean(axis=1), places]),
        )


def _shares(
    corners: Array,  # [M, 3, 2]
    points: Array,  # [M, 2]
) -> Array:
    """[M, 3] barycentric coordinates; all negative of triangles without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def twice_area(p: Array, q: Array, r: Array) -> Array:  # [M, 2] each
        return np.asarray((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])

    whole = twice_area(a, b, c)
    parts = np.column_stack([twice_area(points, *pair) for pair in ((b, c), (c, a), (a, b))])
    flat = np.abs(whole) < 1e-12
    return np.where(flat[:, None], -1.0, parts / np.where(flat, 1.0, whole)[:, None])


def _grow(
    picture: npt.NDArray[np.uint8],  # [H, W, 3]
    painted: npt.NDArray[np.bool_],  # [H, W]
) -> None:
    """Give pixels beside painted ones the colour of one of them."""
    before = painted.copy()
    for axis in (0, 1):
        for to, source in (
            (slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None)),
        ):  # fmt: skip
            here, there = [slice(None)] * 2, [slice(None)] * 2
            here[axis], there[axis] = to, source
            new = before[tuple(there)] & ~painted[tuple(here)]
            picture[tuple(here)][new] = picture[tuple(there)][new]
            painted[tuple(here)] |= new


# --------------------------------------------------------------------------------------------------
# What the views say of places on the surface: colour, and how well the place is known.
#
# Colours are those of the ortho: the map's radiance, as restored from the range of the nearest view
# (export/ortho/drawing.py), whose bound on the amplification holds for a mesh as well.

BATCH = 1 << 16
"""Places worked on at a time; 20 MB."""
SAME_SURFACE = 2.0
"""Truncations between a place and the surface that a view shows, up to which it is that surface."""


@dataclass(frozen=True)
class ObservedColours:
    """Some places as the views see them."""

    radiance: Array
    """[M, 3] J, the mean of the views, those that are near and see it from the front first."""
    nearest: Array
    """[M] range of the nearest view in the mesh's unit; infinite where none sees the place."""
    sigma: Array
    """[M] 1 sigma of the place in the direction that is known least, where rays meet that are each
    known to PICTURE_SIGMA_PX, in the mesh's unit; infinite of what fewer than two views see."""

    footprint: Array
    """[M] smallest width of a picture's pixel there, in the mesh's unit; infinite of what none
    sees."""

    @property
    def sigma_px(self) -> Array:
        """[M] sigma in widths of a pixel; infinite where sigma is."""
        known = np.isfinite(self.sigma)
        return np.where(known, self.sigma / np.where(known, self.footprint, 1.0), np.inf)


def look_at(
    surfaces: ViewSurfaces,
    places: Array,  # [M, 3]
    voxel: float,
) -> ObservedColours:
    """How the views see ``places`` of the surface."""
    count = len(places)
    total, weights = np.zeros((count, 3)), np.zeros(count)
    nearest, footprint = np.full(count, np.inf), np.full(count, np.inf)
    information = np.zeros((count, 3, 3))
    for number in surfaces.around(places.min(axis=0), places.max(axis=0)):
        view, layers = surfaces.views[number], surfaces.surface(number)
        offset = places - view.T_uc.t
        local = offset @ view.T_uc.R
        ahead = np.flatnonzero(view.shows(local))
        column, row = np.floor(view.camera.project(local[ahead])).astype(np.intp).T
        ranges = np.linalg.norm(offset[ahead], axis=1)
        cosine = layers[COSINE][row, column].astype(np.float64)
        reach = SAME_SURFACE * truncation(layers[SIGMA][row, column], voxel)
        with np.errstate(invalid="ignore"):
            same = np.abs(layers[RANGE][row, column] - ranges) * cosine <= reach
        ahead, row, column, ranges = ahead[same], row[same], column[same], ranges[same]
        weight = (cosine[same] / ranges) ** 2
        colours = surfaces.radiance(number)[:, row, column].T.astype(np.float64)
        total[ahead] += weight[:, None] * colours
        weights[ahead] += weight
        nearest[ahead] = np.minimum(nearest[ahead], ranges)
        rays = offset[ahead] / ranges[:, None]
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        width = ranges / view.camera.fx
        footprint[ahead] = np.minimum(footprint[ahead], width)
        information[ahead] += across / ((PICTURE_SIGMA_PX * width) ** 2)[:, None, None]
    least = np.linalg.eigvalsh(information)[:, 0]
    with np.errstate(divide="ignore"):
        sigma = np.where(least > 0.0, 1.0 / np.sqrt(np.maximum(least, 0.0)), np.inf)
    return ObservedColours(total / np.maximum(weights, 1e-30)[:, None], nearest, sigma, footprint)


def batches(count: int) -> Iterator[slice]:
    """Parts of ``count`` places."""
    for first in range(0, count, BATCH):
        yield slice(first, min(count, first + BATCH))


def shown_colours(
    colours: Colours, seen: ObservedColours
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
    """RGB [M, 3] of places, and which of them [M] a view sees."""
    radiance = checkpoint_in(seen.radiance[None].astype(np.float32), colours.device)
    found, _ = colours.of(radiance, seen.nearest[None])
    return found[0], np.isfinite(seen.nearest)
