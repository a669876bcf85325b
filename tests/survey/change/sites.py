"""A rough ground with a box on it, as two days would show it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.change.comparison import SurfaceComparison, compare
from aquaflow.survey.change.moved import with_moves
from aquaflow.survey.change.patches import Patch, find_patches
from aquaflow.survey.change.registration import Registration
from aquaflow.survey.change.surface import Surface
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces
from tests.survey.export.mesh_scenes import CAMERA, above_plane, surfaces_of

Array = npt.NDArray[np.float64]

RESOLUTION, SPACING = 0.03, 0.012
HALF, TALL = 0.12, 0.15
"""Of the box, m."""
WORN = 0.003
"""1 sigma of the points' heights."""


def height(places: Array, box: tuple[float, float] | None) -> Array:
    """[...] of places [..., 2]."""
    x, y = places[..., 0], places[..., 1]
    ground = 0.01 * np.sin(9.0 * x) * np.cos(7.0 * y)
    if box is None:
        return np.asarray(ground)
    inside = (np.abs(x - box[0]) < HALF) & (np.abs(y - box[1]) < HALF)
    return np.where(inside, TALL, ground)


def brightness(places: Array, box: tuple[float, float] | None) -> Array:
    """[...] a pattern of the ground, and one of the box that moves with it."""
    x, y = places[..., 0], places[..., 1]
    ground = 0.3 + 0.08 * np.sin(23.0 * x + 5.0) * np.sin(31.0 * y)
    if box is None:
        return np.asarray(ground)
    inside = (np.abs(x - box[0]) < HALF) & (np.abs(y - box[1]) < HALF)
    own = 0.5 + 0.2 * np.sin(40.0 * (x - box[0])) * np.sin(33.0 * (y - box[1]) + 1.0)
    return np.where(inside, own, ground)


def views_of(
    box: tuple[float, float] | None, work: Path, camera: CameraModel = CAMERA
) -> ViewSurfaces:
    """What five cameras show; the box has no sides, and hides what is behind its upper side."""

    def ranges(centre: Array, rays: Array) -> Array:
        top, floor = ((z - centre[2]) / rays[..., 2] for z in (TALL, 0.0))
        places = (centre + rays * top[..., None])[..., :2]
        return np.asarray(np.where(height(places, box) >= TALL, top, floor))

    return surfaces_of(above_plane(), [ranges] * 5, work, camera)


def day(
    work: Path,
    seed: int,
    box: tuple[float, float] | None = None,
    light: float = 1.0,
    bleached: float = 0.0,
    views: ViewSurfaces | None = None,
) -> Surface:
    """A day's surface; ``bleached``: radius of a patch around the origin without its colour."""
    random = np.random.default_rng(seed)
    steps = np.arange(-0.6, 0.6, SPACING)
    xy = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    xy = xy + random.uniform(-0.3, 0.3, xy.shape) * SPACING
    z = height(xy, box) + WORN * random.standard_normal(len(xy))
    bright = brightness(xy, box) + 0.01 * random.standard_normal(len(xy))
    colours = bright[:, None] * np.array([1.2, 1.0, 0.7])
    pale = np.hypot(*xy.T) < bleached
    colours[pale] = 1.6 * bright[pale, None] * np.array([1.03, 1.0, 0.97])
    return Surface(
        np.column_stack([xy, z]), np.tile((0.0, 0.0, 1.0), (len(xy), 1)),
        np.full(len(xy), 0.002), light * colours, np.full(len(xy), 0.15), RESOLUTION, 1.44,
        views or views_of(box, work), Sim3.identity(),
    )  # fmt: skip


KNOWN = Registration(Sim3.identity(), np.diag(np.full(7, 1e-8)), np.zeros(3), 0.003, 1.0)
"""Days in one frame."""


def changes(first: Surface, second: Surface) -> tuple[list[Patch], SurfaceComparison]:
    """All that changed."""
    found = compare(first, second, KNOWN, 0.05, None, 0.4, lambda what, done, total: None)
    patches, found = find_patches(found, first, second)
    return with_moves(patches, found, first, second, KNOWN)
