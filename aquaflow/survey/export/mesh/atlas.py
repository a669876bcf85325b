"""A texture for a mesh: its triangles laid out in a picture, whose pixels get their own colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.base.errors import load
from aquaflow.survey.export.mesh.seen_places import batches
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Colour = Callable[[Array], tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]]
"""RGB [M, 3] of places [M, 3], and which of them [M] have a colour."""

LARGEST_SIDE = 8192
"""Pixels of a texture: what any desktop's GPU takes (D3D 10 asks for it, OpenGL 4.1 for twice)."""
FILLED = 0.5
"""Share of a texture that triangles are expected to take; xatlas reaches 0.8 on the reef."""
COARSER = 1.1
"""What texels are larger by than a texture that is too large is too wide."""
GROUP = 250
"""Triangles that are laid out together, neighbours in space: for 206 000 of the reef xatlas takes
6.2 CPU s so, 9.6 in groups of 500, 15.5 of 1000; on 15 % more pixels than in groups of 500."""
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
    texel = max(texel, math.sqrt(mesh.area() / FILLED) / LARGEST_SIDE)
    layout = _lay_out_at(mesh, texel)
    while (side := max(layout.width, layout.height)) > LARGEST_SIDE:
        # Padding takes its share, however coarse the texels are.
        texel *= COARSER * side / LARGEST_SIDE
        layout = _lay_out_at(mesh, texel)
    return layout


def _lay_out_at(mesh: TriangleMesh, texel: float) -> AtlasLayout:
    """``mesh`` with ``texel`` as the side of a pixel, however large the picture becomes."""
    xatlas = load("xatlas", "a textured mesh", "survey")
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
    of the nearest vertex where a place has none."""
    size = (layout.height, layout.width)
    picture, painted = np.zeros((*size, 3), np.uint8), np.zeros(size, bool)
    missing = []
    for done, (rows, columns, places) in enumerate(_texels(mesh, layout)):
        for part in batches(len(places)):
            found, known = colour(places[part])
            own = rows[part][known], columns[part][known]
            picture[own], painted[own] = found[known], True
            missing.append(tuple(each[part][~known] for each in (rows, columns, places)))
        if progress is not None:
            progress(done + 1, -(-len(mesh.faces) // FACES))
    rows, columns, places = (np.concatenate(each) for each in zip(*missing, strict=True))
    if painted.any() and len(places):
        own = rows, columns
        picture[own], painted[own] = _nearest_colours(mesh, colour, places), True
    for _ in range(PADDING_PX):
        _grow(picture, painted)
    return picture


def _nearest_colours(
    mesh: TriangleMesh,
    colour: Colour,
    places: Array,  # [M, 3]
) -> npt.NDArray[np.uint8]:
    """RGB [M, 3] of the nearest vertices that have a colour; black if none has."""
    parts = [colour(mesh.vertices[part]) for part in batches(len(mesh.vertices))]
    found, known = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not known.any():
        return np.zeros((len(places), 3), np.uint8)
    return np.asarray(found[known][cKDTree(mesh.vertices[known]).query(places)[1]])


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
