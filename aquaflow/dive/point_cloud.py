"""The surface of a dive's map as points: where a Gaussian stands, in what colour, facing where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import Placement
from aquaflow.dive.ply import PlyGaussians, read_ply
from aquaflow.dive.posed_views import PosedView, read_posed_views
from aquaflow.geometry.similarity import rotation_from_quaternion

Array = npt.NDArray[np.float64]

LEAST_OPACITY = 0.3
"""Opacity from which a Gaussian becomes a point. The median opacity in eight maps of synthetic and
real dives is 0.33 to 0.64: what is fainter blends colours, and marks no surface by itself."""
CHUNK = 1 << 16
"""Points worked on at a time; some 10 MB."""


@dataclass(frozen=True)
class CloudPoints:
    """Some points of a cloud, in the upright frame (:mod:`aquaflow.dive.placement`)."""

    positions: Array
    """[N, 3] unit of the cloud."""
    colours: npt.NDArray[np.uint8]
    """[N, 3] RGB."""
    normals: Array
    """[N, 3] unit length."""
    sigma: Array
    """[N] unit of the cloud: the standard deviation of the Gaussian along the ray to the camera
    that its normal looks at. It says how thick the map is there. It holds no error of poses and
    scale: those are in metric.json and trajectory.csv."""


class PointCloud:
    """The points of one map, computed a chunk at a time."""

    def __init__(
        self, splats: PlyGaussians, views: Sequence[PosedView], placement: Placement
    ) -> None:
        """``splats`` and ``views`` are in the upright frame of ``placement``."""
        self._splats, self._views, self.placement = splats, views, placement
        turned = np.linalg.norm(splats.wxyz, axis=1) > 0.0
        self._chosen = np.flatnonzero((splats.opacities >= LEAST_OPACITY) & turned)

    def __len__(self) -> int:
        """Number of points."""
        return len(self._chosen)

    def reach(self) -> float:
        """The largest coordinate of a point, without its sign; 0 of an empty cloud."""
        return float(np.abs(self._splats.means[self._chosen]).max(initial=0.0))

    def chunks(self) -> Iterator[CloudPoints]:
        """All points, in the order of the map's file."""
        for first in range(0, len(self), CHUNK):
            yield self._points(self._chosen[first : first + CHUNK])

    def _points(
        self,
        chosen: npt.NDArray[np.intp],  # [N] of the Gaussians
    ) -> CloudPoints:
        splats = self._splats
        positions = splats.means[chosen].astype(np.float64)
        scales = splats.scales[chosen].astype(np.float64)
        R = rotation_from_quaternion(splats.wxyz[chosen].astype(np.float64))
        rays = positions - nearest_cameras(positions, self._views)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
        shortest = np.argmin(scales, axis=1)
        normals = np.take_along_axis(R, shortest[:, None, None], axis=2)[..., 0]
        normals = np.where((normals * rays).sum(axis=1, keepdims=True) > 0.0, -normals, normals)
        along = np.einsum("nji,nj->ni", R, rays) * scales
        colours = np.clip(splats.colours[chosen], 0.0, 1.0) * 255.0 + 0.5
        return CloudPoints(
            positions, colours.astype(np.uint8), normals, np.linalg.norm(along, axis=1)
        )


def nearest_cameras(
    points: Array,  # [N, 3] upright frame
    views: Sequence[PosedView],
) -> Array:
    """[N, 3] centre of the nearest camera in whose picture each point lies; of a point that lies
    in none, the nearest camera's. What stands in between is not looked at."""
    centres = np.stack([view.T_uc.t for view in views])
    found = centres[KDTree(centres).query(points)[1]]
    least = np.full(len(points), np.inf)
    for view in views:
        from_camera = points - view.T_uc.t
        distance = np.einsum("ni,ni->n", from_camera, from_camera)
        nearer = np.flatnonzero(distance < least)
        seen = nearer[view.shows(from_camera[nearer] @ view.T_uc.R)]
        least[seen], found[seen] = distance[seen], view.T_uc.t
    return np.asarray(found)


def read_point_cloud(dive: Dive, water: bool = False) -> PointCloud:
    """The points of the dive's largest sub-map; ``water``: in the colours that it gives them.

    Raises:
        InputError: the dive has no map, or nothing in it is opaque enough.
        ConfigError: the dive's settings cannot be read.
    """
    views, where = read_posed_views(dive, dive.map())
    cloud = PointCloud(read_splats(dive, where, water), views, where)
    if not len(cloud):
        raise InputError(
            f"no Gaussian in the map of {dive} has an opacity of {LEAST_OPACITY} or more; refine "
            "the dive for longer (--refine-steps)"
        )
    return cloud


def read_splats(dive: Dive, placement: Placement, water: bool) -> PlyGaussians:
    """The Gaussians of the dive's largest sub-map in the upright frame: without water, or with
    ``water`` as seen through it at the dive's median range.

    Raises:
        InputError: the dive has no such map, or an empty one.
    """
    path = dive.file("map.ply" if water else "map_clear.ply")
    splats = read_ply(path)
    if not len(splats.means):
        raise InputError(f"{path} holds no Gaussians; map the dive again")
    return splats.transform(placement.T_un)
