"""What the views say of places on the surface: colour, and how well the place is known.

Colours are those of the ortho: the map's radiance, as restored from the range of the nearest view
(export/ortho/colours.py), whose bound on the amplification holds for a mesh as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.render.transfers import checkpoint_in
from aquaflow.survey.export.mesh.blocks import truncation
from aquaflow.survey.export.mesh.view_surfaces import COSINE, RANGE, SIGMA, ViewSurfaces
from aquaflow.survey.export.ortho.colours import Colours
from aquaflow.survey.export.ortho.sightings import PICTURE_SIGMA_PX

Array = npt.NDArray[np.float64]

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
