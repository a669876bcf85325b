"""What the views say of places on the surface: their colour, and how well they are known.

Colours are those of the ortho: the map's radiance, as restored from the range of the nearest view
(export/ortho/drawing.py), whose bound on the amplification holds for a mesh as well.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.render.library import Library
from aquaflow.render.transfers import checkpoint_in
from aquaflow.survey.export.mesh.view_surfaces import (
    COSINE,
    RANGE,
    SIGMA,
    NativeSurface,
    ViewSurfaces,
    truncation,
)
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.export.ortho.sightings import PICTURE_SIGMA_PX, ray_information

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

BATCH = 1 << 16
"""Places worked on at a time; 20 MB."""
SAME_SURFACE = 2.0
"""Truncations between a place and the surface that a view shows, up to which it is that surface."""


def batches(count: int) -> Iterator[slice]:
    """Parts of ``count`` places."""
    for first in range(0, count, BATCH):
        yield slice(first, min(count, first + BATCH))


@dataclass(frozen=True)
class ObservedColours:
    """Some places as the views see them."""

    radiance: Array
    """[M, 3] J, the mean of the views, those that are near and see it from the front first."""
    nearest: Array
    """[M] range of the nearest view in the mesh's unit; infinite where none sees the place."""


def look_at(
    surfaces: ViewSurfaces,
    places: Array,  # [M, 3]
    voxel: float,
    library: Library | None,
) -> ObservedColours:
    """How the views see ``places`` of the surface; with the compiled kernels, or by numpy."""
    sums = ColourSums.of(places)
    _add_views(sums, surfaces, voxel, library)
    return ObservedColours(sums.total / np.maximum(sums.weights, 1e-30)[:, None], sums.nearest)


def shown_colours(
    colours: Colours, seen: ObservedColours
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
    """RGB [M, 3] of places, and which of them [M] a view sees."""
    radiance = checkpoint_in(seen.radiance[None].astype(np.float32), colours.device)
    found, _ = colours.of(radiance, seen.nearest[None])
    return found[0], np.isfinite(seen.nearest)


def place_sigmas(
    surfaces: ViewSurfaces,
    places: Array,  # [M, 3]
    voxel: float,
    library: Library | None,
) -> tuple[Array, Array]:
    """How well ``places`` of the surface are known, in the direction that is known least, where
    rays meet that are each known to PICTURE_SIGMA_PX: [M] 1 sigma in the mesh's unit, and the same
    in widths of a pixel there, of the nearest view; infinite of what fewer than two views see.
    With the compiled kernels, or by numpy."""
    sums = RaySums.of(places)
    _add_views(sums, surfaces, voxel, library)
    least = np.linalg.eigvalsh(sums.information)[:, 0]
    known = least > 0.0
    sigma = np.where(known, 1.0 / np.sqrt(np.where(known, least, 1.0)), np.inf)
    return sigma, np.where(known, sigma / np.where(known, sums.footprint, 1.0), np.inf)


@dataclass(frozen=True)
class ColourSums:
    """What some views show at places."""

    places: Array
    """[M, 3] in the frame of the mesh."""
    total: Array
    """[M, 3] sum of the radiance, each view's times its weight."""
    weights: Array
    """[M] sum of the weights."""
    nearest: Array
    """[M] least range; infinite where no view shows the place."""

    @staticmethod
    def of(
        places: Array,  # [M, 3]
    ) -> ColourSums:
        """Of no view."""
        count = len(places)
        return ColourSums(
            np.ascontiguousarray(places), np.zeros((count, 3)), np.zeros(count),
            np.full(count, np.inf),
        )  # fmt: skip

    def add_by_numpy(self, surfaces: ViewSurfaces, number: int, voxel: float) -> None:
        """Add what one view shows, readable."""
        seen = _see(surfaces, number, self.places, voxel)
        weight, (row, column) = (seen.cosines / seen.ranges) ** 2, seen.pixels
        self.total[seen.which] += weight[:, None] * surfaces.radiance(number)[:, row, column].T
        self.weights[seen.which] += weight
        self.nearest[seen.which] = np.minimum(self.nearest[seen.which], seen.ranges)

    def add_compiled(
        self, library: Library, surfaces: ViewSurfaces, number: int, voxel: float
    ) -> None:
        """As :meth:`add_by_numpy` (native/see_places.h)."""
        radiance = surfaces.radiance(number).ctypes.data
        sums = (each.ctypes.data for each in (self.total, self.weights, self.nearest))
        given = _NativePlaces.of(self.places, surfaces, number, voxel)
        out = _NativeColours(radiance, *sums)
        library.call("aq_add_colours", ctypes.byref(given), ctypes.byref(out))


@dataclass(frozen=True)
class RaySums:
    """What some views say of where places are."""

    places: Array
    """[M, 3] in the frame of the mesh."""
    information: Array
    """[M, 3, 3] of the place, from rays that are each known to PICTURE_SIGMA_PX."""
    footprint: Array
    """[M] least width of a pixel at the place; infinite where no view shows it."""

    @staticmethod
    def of(
        places: Array,  # [M, 3]
    ) -> RaySums:
        """Of no view."""
        count = len(places)
        return RaySums(
            np.ascontiguousarray(places), np.zeros((count, 3, 3)), np.full(count, np.inf)
        )

    def add_by_numpy(self, surfaces: ViewSurfaces, number: int, voxel: float) -> None:
        """Add what one view says, readable."""
        seen, view = _see(surfaces, number, self.places, voxel), surfaces.views[number]
        rays = (self.places[seen.which] - view.T_uc.t) / seen.ranges[:, None]
        width = seen.ranges / view.camera.fx
        self.information[seen.which] += ray_information(rays, PICTURE_SIGMA_PX * width)
        self.footprint[seen.which] = np.minimum(self.footprint[seen.which], width)

    def add_compiled(
        self, library: Library, surfaces: ViewSurfaces, number: int, voxel: float
    ) -> None:
        """As :meth:`add_by_numpy` (native/see_places.h)."""
        given = _NativePlaces.of(self.places, surfaces, number, voxel)
        sums = (each.ctypes.data for each in (self.information, self.footprint))
        out = _NativeInformation(PICTURE_SIGMA_PX, *sums)
        library.call("aq_add_information", ctypes.byref(given), ctypes.byref(out))


def _add_views(
    sums: ColourSums | RaySums, surfaces: ViewSurfaces, voxel: float, library: Library | None
) -> None:
    """Add what each view says that may show some of the places."""
    for number in surfaces.around(sums.places.min(axis=0), sums.places.max(axis=0)):
        if library is None:
            sums.add_by_numpy(surfaces, number, voxel)
        else:
            sums.add_compiled(library, surfaces, number, voxel)


@dataclass(frozen=True)
class _Sighting:
    """The places that a view shows, K of them."""

    which: Integers
    """[K] numbers of the places."""
    pixels: tuple[Integers, Integers]
    """[K] rows and columns."""
    ranges: Array
    """[K] of the places from the view."""
    cosines: Array
    """[K] of the incidence."""


def _see(
    surfaces: ViewSurfaces,
    number: int,
    places: Array,  # [M, 3]
    voxel: float,
) -> _Sighting:
    """The places that one view shows."""
    view, layers = surfaces.views[number], surfaces.surface(number)
    local = (places - view.T_uc.t) @ view.T_uc.R
    which = np.flatnonzero(view.shows(local))
    column, row = np.floor(view.camera.project(local[which])).astype(np.intp).T
    ranges = np.linalg.norm(local[which], axis=1)
    cosines = layers[COSINE][row, column].astype(np.float64)
    reach = SAME_SURFACE * truncation(layers[SIGMA][row, column], voxel)
    with np.errstate(invalid="ignore"):
        same = np.abs(layers[RANGE][row, column] - ranges) * cosines <= reach
    return _Sighting(which[same], (row[same], column[same]), ranges[same], cosines[same])


class _NativePlaces(ctypes.Structure):
    """``SeePlaces`` of native/see_places.h."""

    _fields_ = (("view", NativeSurface), ("places", ctypes.c_void_p), ("count", ctypes.c_int64))

    @staticmethod
    def of(
        places: Array,  # [M, 3]
        surfaces: ViewSurfaces,
        number: int,
        voxel: float,
    ) -> _NativePlaces:
        """Of places, and a view that may show some of them."""
        view = NativeSurface.of(surfaces, number, voxel, SAME_SURFACE)
        return _NativePlaces(view, places.ctypes.data, len(places))


class _NativeColours(ctypes.Structure):
    """``PlaceColours`` of native/see_places.h."""

    _fields_ = tuple(
        (name, ctypes.c_void_p) for name in ("radiance", "total", "weights", "nearest")
    )


class _NativeInformation(ctypes.Structure):
    """``PlaceInformation`` of native/see_places.h."""

    _fields_ = (
        ("sigma_px", ctypes.c_double),
        ("information", ctypes.c_void_p),
        ("footprint", ctypes.c_void_p),
    )
