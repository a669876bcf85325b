"""A dive's map as others take it: points of its surface, and its views, in the upright frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import clear_splats
from aquaflow.dive.placement import Placement, placement
from aquaflow.dive.ply import PlyFile, PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, rotation_from_quaternion
from aquaflow.render.views import View, in_time
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

LEAST_OPACITY = 0.3
"""Opacity from which a Gaussian becomes a point. The median opacity in eight maps of synthetic and
real dives is 0.33 to 0.64: what is fainter blends colours, and marks no surface by itself."""
NEAREST_CAMERAS = 8
"""That are asked first whether they show a point; a survey's point lies in the nearest one."""
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
        self, splats: PlyGaussians | PlyFile, views: Sequence[PosedView], placement: Placement
    ) -> None:
        """``splats`` and ``views`` are in the upright frame of ``placement``."""
        self._splats, self._views, self.placement = splats, views, placement
        self._chosen, self._reach = self._choose()

    def _choose(self) -> tuple[npt.NDArray[np.intp], float]:
        """[N] numbers of the Gaussians that are points, and their largest coordinate."""
        chosen, reach = [np.zeros(0, np.intp)], 0.0
        for first in range(0, len(self._splats), CHUNK):
            part = self._splats.rows(slice(first, first + CHUNK))
            turned = np.linalg.norm(part.wxyz, axis=1) > 0.0
            found = np.flatnonzero((part.opacities >= LEAST_OPACITY) & turned)
            chosen.append(first + found)
            reach = max(reach, float(np.abs(part.means[found]).max(initial=0.0)))
        return np.concatenate(chosen), reach

    def __len__(self) -> int:
        """Number of points."""
        return len(self._chosen)

    def reach(self) -> float:
        """The largest coordinate of a point, without its sign; 0 of an empty cloud."""
        return self._reach

    def sample(self, most: int) -> Array:
        """[M, 3] positions of about ``most`` points, evenly from the map's file."""
        step = max(len(self) // most, 1)
        return self._splats.rows(self._chosen[::step]).means.astype(np.float64)

    def chunks(self) -> Iterator[CloudPoints]:
        """All points, in the order of the map's file."""
        for first in range(0, len(self), CHUNK):
            yield self._points(self._chosen[first : first + CHUNK])

    def _points(
        self,
        chosen: npt.NDArray[np.intp],  # [N] of the Gaussians
    ) -> CloudPoints:
        splats = self._splats.rows(chosen)
        positions = splats.means.astype(np.float64)
        scales = splats.scales.astype(np.float64)
        R = rotation_from_quaternion(splats.wxyz.astype(np.float64))
        rays = positions - nearest_cameras(positions, self._views)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
        shortest = np.argmin(scales, axis=1)
        normals = np.take_along_axis(R, shortest[:, None, None], axis=2)[..., 0]
        normals = np.where((normals * rays).sum(axis=1, keepdims=True) > 0.0, -normals, normals)
        along = np.einsum("nji,nj->ni", R, rays) * scales
        colours = np.clip(splats.colours, 0.0, 1.0) * 255.0 + 0.5
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
    tree = KDTree(centres)
    found = centres[tree.query(points)[1]]
    left, first, last = np.arange(len(points)), 0, NEAREST_CAMERAS
    while len(left) and first < len(views):  # of nearly all points one of the nearest shows it
        ranks = np.arange(first, min(last, len(views))) + 1
        numbers = np.asarray(tree.query(points[left], k=ranks)[1])
        shown = _shown_by(points[left], numbers, views)
        rows = np.flatnonzero(shown.any(axis=1))
        found[left[rows]] = centres[numbers[rows, shown[rows].argmax(axis=1)]]
        left, first, last = np.delete(left, rows), last, 4 * last
    return np.asarray(found)


def _shown_by(
    points: Array,  # [N, 3] upright frame
    numbers: npt.NDArray[np.intp],  # [N, K] of views
    views: Sequence[PosedView],
) -> npt.NDArray[np.bool_]:
    """[N, K] True where a point lies in the picture of that view."""
    shown = np.zeros(numbers.size, np.bool_)
    order = np.argsort(numbers, axis=None, kind="stable")
    asked, starts = np.unique(numbers.ravel()[order], return_index=True)
    for number, part in zip(asked.tolist(), np.split(order, starts[1:]), strict=True):
        T_uc = views[number].T_uc
        local = (points[part // numbers.shape[1]] - T_uc.t) @ T_uc.R
        shown[part] = views[number].shows(local)
    return shown.reshape(numbers.shape)


def read_point_cloud(dive: Dive, water: bool = False) -> PointCloud:
    """The points of the dive's largest sub-map; ``water``: in the colours that it gives them.

    Raises:
        InputError: the dive has no map, or nothing in it is opaque enough.
        ConfigError: the dive's settings cannot be read.
    """
    views, where = read_posed_views(dive, dive.views())
    cloud = PointCloud(read_splats(dive, where, water), views, where)
    if not len(cloud):
        raise InputError(
            f"no Gaussian in the map of {dive} has an opacity of {LEAST_OPACITY} or more; refine "
            "the dive for longer (--refine-steps)"
        )
    return cloud


def read_splats(dive: Dive, placement: Placement, water: bool) -> PlyGaussians | PlyFile:
    """The Gaussians of the dive's largest sub-map in the upright frame: without water, or with
    ``water`` as seen through it at the dive's median range.

    Raises:
        InputError: the dive has no such map, or an empty one.
    """
    if not water and dive.white_balance is not None:
        return clear_splats(dive.filled_map(), dive.frame).transform(placement.T_un)
    path = dive.file("map.ply" if water else "map_clear.ply")
    splats = PlyFile(path)
    if not len(splats):
        raise InputError(f"{path} holds no Gaussians; map the dive again")
    return splats.transform(placement.T_un)


# --------------------------------------------------------------------------------------------------
# The views of a dive's map with their cameras and poses in the upright frame.


@dataclass(frozen=True)
class PosedView:
    """A frame that the map was made from."""

    frame_index: int
    """Position in the recording."""
    camera: CameraModel
    """Pinhole, of the prepared pictures."""
    T_uc: Sim3
    """Camera (x right, y down, z forward) to the upright frame; rigid, in the map's unit."""

    def shows(
        self,
        points: npt.NDArray[np.float64],  # [N, 3] camera frame
    ) -> npt.NDArray[np.bool_]:
        """[N] True for points that lie in the picture."""
        u, v = np.moveaxis(self.camera.project(points), -1, 0)
        inside = (u >= 0.0) & (u < self.camera.width) & (v >= 0.0) & (v < self.camera.height)
        return np.asarray(inside & (points[:, 2] > 0.0))


def posed_views(views: Iterable[View], frame: WorldFrame, where: Placement) -> list[PosedView]:
    """The views in the order of the recording."""
    posed = []
    for view in in_time(views):
        T_nc = frame.pose(view.T_wc)
        T_uc = where.T_un @ Sim3(T_nc.R, T_nc.t, 1.0)
        posed.append(PosedView(view.frame_index, view.camera, T_uc))
    return posed


def read_posed_views(dive: Dive, views: Sequence[View]) -> tuple[list[PosedView], Placement]:
    """The ``views`` of the map of ``dive``, and where they lie.

    Raises:
        InputError: there are none, or the dive's metric.json is damaged.
    """
    frame = dive.frame
    where = placement(frame)
    posed = posed_views(views, frame, where)
    if not posed:
        raise InputError(f"the map of {dive} has no views; map the dive again")
    return posed, where
