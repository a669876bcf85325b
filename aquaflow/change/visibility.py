"""Whether a day's pictures look through a place, or show something there.

A surface that a map lacks is not a thing that is gone: it may be hidden, or was too badly seen to
become one. Something is gained or lost only where the other day's views see past it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.export.mesh.view_surfaces import COSINE, RANGE, ViewSurfaces

Array = npt.NDArray[np.float64]

LEAST_VIEWS = 2
"""That see past a place: one view alone may err, as in the mesh and the ortho."""


def seen_past(
    views: ViewSurfaces,
    places: Array,  # [N, 3]
    margin: Array,  # [N] distance across the surface behind, from which it is another one
) -> npt.NDArray[np.bool_]:
    """[N] True for places that more views see past than show something at, and two at least."""
    past, there = np.zeros(len(places), np.int32), np.zeros(len(places), np.int32)
    if len(places) == 0:
        return past > there
    for number in views.around(places.min(axis=0), places.max(axis=0)):
        view, layers = views.views[number], views.surface(number)
        offset = places - view.T_uc.t
        local = offset @ view.T_uc.R
        ahead = np.flatnonzero(view.shows(local))
        column, row = np.floor(view.camera.project(local[ahead])).astype(np.intp).T
        cosine = layers[COSINE][row, column].astype(np.float64)
        behind = layers[RANGE][row, column] - np.linalg.norm(offset[ahead], axis=1)
        with np.errstate(invalid="ignore"):
            past[ahead] += behind * cosine > margin[ahead]
            there[ahead] += np.abs(behind * cosine) <= margin[ahead]
    return (past >= LEAST_VIEWS) & (past > there)
