"""Surfaces of known shape as views would show them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.dive.point_cloud import PosedView
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.mesh.blocks import Blocks
from aquaflow.survey.export.mesh.surface import SurfaceBuilder, fuse
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces, surface_layers, unit_rays

Array = npt.NDArray[np.float64]
Ranges = Callable[[Array, Array], Array]
"""[H, W] of a camera's centre [3] and its rays [H, W, 3]; NaN where there is nothing."""

CAMERA = CameraModel(120, 90, 100.0, 100.0, 60.0, 45.0)
FAR_CAMERA = CameraModel(96, 96, 220.0, 220.0, 48.0, 48.0)
VOXEL = 0.03
SIGMA = 0.005
RADIUS = 1.0
DISTANCE = 6.0
"""Of the cameras from the middle of the sphere."""


def looking(eye: Array, target: Array) -> Sim3:
    """T_uc of a camera at ``eye``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    helper = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    return Sim3(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def around_sphere() -> list[Sim3]:
    """26 cameras, from the faces, edges and corners of a cube."""
    cube = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    places = [place / np.linalg.norm(place) for place in cube if place.any()]
    return [looking(DISTANCE * place, np.zeros(3)) for place in places]


def to_sphere(centre: Array, rays: Array) -> Array:
    """Ranges of the sphere around the origin."""
    along = rays @ centre
    left = along**2 - (centre @ centre - RADIUS**2)
    return np.where(left > 0.0, -along - np.sqrt(np.maximum(left, 0.0)), np.nan)


def above_plane() -> list[Sim3]:
    """Five cameras that look down on z = 0."""
    places = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.1), (0.1, 0.3), (0.0, -0.3))
    return [looking(np.array([x, y, 2.0]), np.array([x, y + 0.2, 0.0])) for x, y in places]


def to_plane(centre: Array, rays: Array) -> Array:
    """Ranges of z = 0."""
    return np.asarray(-centre[2] / rays[..., 2])


def plane_with_hole(centre: Array, rays: Array) -> Array:
    """Ranges of z = 0 without what is nearer than 0.25 to the origin."""
    ranges = to_plane(centre, rays)
    places = centre + rays * ranges[..., None]
    return np.where(np.hypot(places[..., 0], places[..., 1]) < 0.25, np.nan, ranges)


def surfaces_of(
    poses: Sequence[Sim3], ranges: Sequence[Ranges], work: Path, camera: CameraModel = CAMERA
) -> ViewSurfaces:
    """What cameras at ``poses`` show, each by one of ``ranges``; J is the place, plus 0.5."""
    views = [PosedView(number, camera, pose) for number, pose in enumerate(poses)]
    drawn = []
    for view, of in zip(views, ranges, strict=True):
        rays = unit_rays(camera) @ view.T_uc.R.T
        found = of(view.T_uc.t, rays)
        colours = np.moveaxis(view.T_uc.t + rays * found[..., None] + 0.5, -1, 0)
        layers = surface_layers(camera, found, np.full(found.shape, SIGMA))
        drawn.append((layers, colours.astype(np.float32)))
    return ViewSurfaces(views, drawn, work)


def fused_mesh(surfaces: ViewSurfaces, voxel: float = VOXEL, least_views: int = 2) -> TriangleMesh:
    """All chunks of a surface."""
    builder = SurfaceBuilder(voxel)
    for chunk in Blocks(surfaces, voxel).chunks():
        builder.add(chunk, fuse(surfaces, chunk, voxel, least_views))
    return builder.mesh()
