"""Whether a day's pictures look through a place, or show something there.

A surface that a map lacks is not a thing that is gone: it may be hidden, or was too badly seen to
become one. Something is gained or lost only where the other day's views see past it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.survey.export.mesh.view_surfaces import COSINE, RANGE, ViewSurfaces

Array = npt.NDArray[np.float64]
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
