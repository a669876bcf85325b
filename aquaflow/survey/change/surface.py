"""The surface of a dive as the comparison takes it: points, normals, sigmas, colours.

It is the surface that ``aquaflow export --format ply`` writes (export/mesh), in the ground axes of
the first dive: what two views at least agree on, with the sigma of where their rays meet, in the
colours without water (export/ortho/drawing.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.library import library_or_none
from aquaflow.render.transfers import checkpoint_in
from aquaflow.survey.export.mesh.export_mesh import VOXEL_PX, fused_surface
from aquaflow.survey.export.mesh.seen_places import batches, look_at
from aquaflow.survey.export.mesh.view_surfaces import COSINE, RANGE, ViewSurfaces, surfaces_of_map
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.measure.drawn_heights import MATCH_PX
from aquaflow.water.white_balance import CONTRAST

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""


@dataclass(frozen=True)
class Surface:
    """Points of a surface, in the ground axes of the first dive."""

    points: Array
    """[N, 3]"""
    normals: Array
    """[N, 3] unit, towards the cameras."""
    sigma: Array
    """[N] 1 sigma of a point in the direction that is known least."""
    colours: Array
    """[N, 3] without water, RGB; grey is that of the camera with no water before it: the gains by
    which restored pictures keep the colours of what is nearest (docs/water.md) are taken off."""
    colour_sigma: Array
    """[N] relative 1 sigma of the colour that restoration left open."""
    resolution: float
    """Distance from which the map tells points apart."""
    area: float
    """Of the surface."""
    views: ViewSurfaces
    """What the pictures show."""
    T_views: Sim3
    """From the surface's axes to those of ``views``."""

    def move(self, T: Sim3) -> Surface:
        """The same elsewhere."""
        return replace(
            self, points=T.apply(self.points), normals=self.normals @ T.R.T,
            sigma=T.scale * self.sigma, resolution=T.scale * self.resolution,
            area=T.scale**2 * self.area, T_views=self.T_views @ T.inverse(),
        )  # fmt: skip

    def seen_past(
        self,
        places: Array,  # [N, 3]
        margin: Array,  # [N]
    ) -> npt.NDArray[np.bool_]:
        """[N] True for places past which this day's pictures show something, by ``margin``."""
        at, across = self.T_views.apply(places), self.T_views.scale * margin
        return look_at_places(self.views, at, across).seen_past


def surface_of(
    mapper: Mapper, T_gm: Sim3, work: Path, voxel: float | None, progress: Progress
) -> tuple[Surface, float]:
    """The surface of a map, and the side of the voxels that it was made with.

    Args:
        T_gm: from the map's world to the ground axes, and to their unit.
        work: folder of files that end with the call.
        voxel: None: two pixels of the pictures at their median range.

    Raises:
        InputError: scikit-image is missing, or too little is seen by two views.
    """
    views = surfaces_of_map(mapper, T_gm, work, partial(progress, "views"))
    side = voxel or VOXEL_PX * views.footprint
    found = fused_surface(views, side, progress)
    mesh, colours = found.mesh, Colours(mapper, T_gm.scale, None)
    balance = mapper.scene.balance
    grey = np.ones(3) if balance is None else np.asarray(balance.white)
    shown, sure = [], []
    for part in batches(len(mesh.vertices)):
        seen = look_at(views, mesh.vertices[part], side, library_or_none())
        radiance = checkpoint_in(seen.radiance[None].astype(np.float32), colours.device)
        rgb, confidence = colours.of(radiance, seen.nearest[None])
        shown.append(rgb[0] / (255.0 * grey))
        sure.append(confidence[0])
    known: Array = np.clip(np.concatenate(sure).astype(np.float64), 0.0, 1.0)
    surface = Surface(
        mesh.vertices, mesh.normals(), found.sigma, np.concatenate(shown),
        relative_colour_sigma(known), MATCH_PX * views.footprint, mesh.area(), views,
        Sim3.identity(),
    )  # fmt: skip
    return surface, side


def relative_colour_sigma(
    confidence: Array,  # [N] in [0, 1], share of a colour that follows the picture
) -> Array:
    """[N] relative 1 sigma of restored colours.

    A restored colour has the posterior covariance (1 - G A) S of water/white_balance.py,
    whose prior has the relative deviation CONTRAST; the confidence is the mean eigenvalue of G A.
    """
    return CONTRAST * np.sqrt(1.0 - confidence)


# --------------------------------------------------------------------------------------------------
# Whether a day's pictures look through a place, or show something there.
#
# A surface that a map lacks is not a thing that is gone: it may be hidden, or was too badly seen to
# become one. Something is gained or lost only where the other day's views see past it.

Mask = npt.NDArray[np.bool_]
Count = npt.NDArray[np.int32]

LEAST_VIEWS = 2
"""That see past a place: one view alone may err, as in the mesh and the ortho."""


@dataclass(frozen=True)
class ViewLookup:
    """What the views of a dive show at places."""

    there: Count
    """[N] views that show a surface there."""
    past: Count
    """[N] views that show a surface behind it."""
    footprint: Array
    """[N] what a pixel of the nearest view that shows it there is across; infinite: none does."""

    @property
    def shown(self) -> Mask:
        """[N] True for places where there is something."""
        return (self.there >= LEAST_VIEWS) & (self.there >= self.past)

    @property
    def seen_past(self) -> Mask:
        """[N] True for places that more views see past than show something at, and two at least."""
        return (self.past >= LEAST_VIEWS) & (self.past > self.there)


def look_at_places(
    views: ViewSurfaces,
    places: Array,  # [N, 3]
    margin: Array,  # [N] distance across the surface behind, from which it is another one
) -> ViewLookup:
    """What all views show at the places."""
    past, there = np.zeros(len(places), np.int32), np.zeros(len(places), np.int32)
    footprint = np.full(len(places), np.inf)
    if len(places) == 0:
        return ViewLookup(there, past, footprint)
    reach = margin.max()  # what lies a little below all that a view shows is there, too
    for number in views.around(places.min(axis=0) - reach, places.max(axis=0) + reach):
        view, layers = views.views[number], views.surface(number)
        offset = places - view.T_uc.t
        local = offset @ view.T_uc.R
        ahead = np.flatnonzero(view.shows(local))
        column, row = np.floor(view.camera.project(local[ahead])).astype(np.intp).T
        cosine = layers[COSINE][row, column].astype(np.float64)
        away = np.linalg.norm(offset[ahead], axis=1)
        behind = layers[RANGE][row, column] - away
        with np.errstate(invalid="ignore"):
            past[ahead] += behind * cosine > margin[ahead]
            shown = np.abs(behind * cosine) <= margin[ahead]
        there[ahead] += shown
        near = ahead[shown]
        footprint[near] = np.minimum(footprint[near], away[shown] / view.camera.fx)
    return ViewLookup(there, past, footprint)
