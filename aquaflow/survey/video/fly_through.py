"""A flight through the map of a dive, along the camera's way but smooth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import splats_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import checkpoint_in, picture_out
from aquaflow.render.views import View, in_time
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.video.encoder import check_name, video_file

Progress = Callable[[int, int], None]
Picture = npt.NDArray[np.uint8]

FPS = 25.0
"""Pictures a second: smooth to the eye."""
SECONDS_PER_KNOT = 1.0
"""Of the flight between two poses that it passes through."""
LEAST_KNOTS = 4
"""Of a cubic spline."""


def fly_through(
    dive: Dive,
    path: Path,
    seconds: float,
    water: bool = False,
    width: int | None = None,
    progress: Progress | None = None,
) -> int:
    """Write a flight of ``seconds`` through the largest sub-map; returns how many pictures it has.

    Without ``water``, colours are bounded as those of an ortho: each Gaussian is recovered at the
    range from which the nearest view saw it (:mod:`aquaflow.survey.export.ortho.drawing`).

    Raises:
        InputError: the dive has no map, or the file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    check_name(path)
    mapper = dive.map()
    views = in_time(mapper.views)
    count = max(round(seconds * FPS), 2)
    knots = max(round(seconds / SECONDS_PER_KNOT), LEAST_KNOTS)
    camera = resize(views[0].camera, width)
    draw = Through(mapper, camera) if water else Clear(mapper, camera)
    with video_file(path, FPS) as file:
        for done, pose in enumerate(smooth_path([v.T_wc for v in views], count, knots), start=1):
            file.add(draw(pose))
            if progress is not None:
                progress(done, count)
    return count


def resize(camera: CameraModel, width: int | None) -> CameraModel:
    """The camera for pictures ``width`` px wide, of the same shape; None: as it is."""
    if width is None:
        return camera
    return camera.resize(width, round(camera.height * width / camera.width))


class Through:
    """The map through its water, in the mean exposure."""

    def __init__(self, mapper: Mapper, camera: CameraModel) -> None:
        self._mapper, self._camera = mapper, camera
        self._blank = np.zeros((camera.height, camera.width, 3), np.uint8)

    def __call__(self, T_wc: Sim3) -> Picture:
        """[H, W, 3] from a pose."""
        view = View(-1, self._blank, self._camera, T_wc, 0, False, device=self._mapper.device)
        return to_bytes(picture_out(self._mapper.show(view).image))


class Clear:
    """The map without its water."""

    @torch.no_grad()
    def __init__(self, mapper: Mapper, camera: CameraModel) -> None:
        self._mapper, self._camera = mapper, camera
        splats, device = splats_of(mapper), mapper.device
        ranges = picture_out(mapper.scene.nearest_cameras(mapper.views)[1]).astype(np.float64)
        radiance = checkpoint_in(np.ascontiguousarray(splats.colours[:, None]), device)
        bounded, _ = Colours(mapper, 1.0, None).of(radiance, ranges[:, None])

        def to_device(values: npt.NDArray[np.floating]) -> torch.Tensor:  # [N, ...]
            return checkpoint_in(np.ascontiguousarray(values, np.float32), device)

        self._splats = (
            *map(to_device, (splats.means, splats.wxyz, splats.scales, splats.opacities)),
            to_device(bounded[:, 0] / 255.0),
        )

    @torch.no_grad()
    def __call__(self, T_wc: Sim3) -> Picture:
        """[H, W, 3] from a pose."""
        camera, blank = self._camera, np.zeros((1, 1, 3), np.uint8)
        view = View(-1, blank, camera, T_wc, 0, False, device=self._mapper.device)
        rows = self._mapper.scene.near(camera, T_wc)
        means, wxyz, scales, opacities, colours = (
            each if rows is None else each.index_select(0, rows) for each in self._splats
        )
        drawn = self._mapper.renderer(
            means, wxyz, scales, opacities, colours, view.viewmat(), view.K(), camera.width,
            camera.height,
        )  # fmt: skip
        return to_bytes(picture_out(drawn.image))


# --------------------------------------------------------------------------------------------------
# A smooth way of a camera along the poses of a dive.

Array = npt.NDArray[np.float64]

SAMPLES_PER_KNOT = 8
"""Places along the path between two knots of the splines, over which it is smoothed."""
SMOOTHING_KNOTS = 0.5
"""Standard deviation of the smoothing, in distances of knots: a vehicle's jitter is gone, and a
turn that takes two knots stays."""


def smooth_path(poses: Sequence[Sim3], count: int, knots: int) -> list[Sim3]:
    """``count`` poses along ``poses`` (T_wc), at an even pace of moving and turning together, where
    a radian of turn counts as a unit of length: the median depth of the first picture.

    ``knots`` is the number of poses that the splines pass through: fewer are smoother.
    """
    places = np.array([pose.t for pose in poses])
    turns = Rotation.from_matrix([pose.R for pose in poses])
    way = _way(places, turns)
    if way[-1] <= 0.0:
        return [Sim3(turns[0].as_matrix(), places[0])] * count
    moved = np.concatenate([[True], np.diff(way) > 0.0])
    way, places, turns = way[moved], places[moved], turns[np.flatnonzero(moved)]
    dense = np.linspace(0.0, way[-1], knots * SAMPLES_PER_KNOT)
    centres = np.stack([np.interp(dense, way, axis) for axis in places.T], axis=1)
    quaternions = _continuous(_slerp(way, turns, dense).as_quat())
    sigma = SMOOTHING_KNOTS * SAMPLES_PER_KNOT
    centres = gaussian_filter1d(centres, sigma, axis=0, mode="nearest")
    quaternions = gaussian_filter1d(quaternions, sigma, axis=0, mode="nearest")
    chosen = np.linspace(0, len(dense) - 1, knots).round().astype(int)
    at = np.linspace(0.0, dense[-1], count)
    new_places = CubicSpline(dense[chosen], centres[chosen])(at)
    new_turns = RotationSpline(dense[chosen], Rotation.from_quat(quaternions[chosen]))(at)
    return [Sim3(R, t) for R, t in zip(new_turns.as_matrix(), new_places, strict=True)]


def _way(
    places: Array,  # [N, 3]
    turns: Rotation,
) -> Array:
    """[N] how far it is to each pose, moving and turning."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    angles = (turns[:-1].inv() * turns[1:]).magnitude() if len(places) > 1 else np.zeros(0)
    return np.concatenate([[0.0], np.cumsum(steps + angles)])


def _slerp(
    way: Array,  # [N] increasing
    turns: Rotation,
    at: Array,  # [M]
) -> Rotation:
    from scipy.spatial.transform import Slerp

    return Slerp(way, turns)(np.clip(at, way[0], way[-1]))


def _continuous(
    quaternions: Array,  # [N, 4]
) -> Array:
    """The same rotations without jumps of sign, which would not average."""
    same = np.einsum("ni,ni->n", quaternions[:-1], quaternions[1:]) >= 0.0
    signs = np.cumprod(np.where(np.concatenate([[True], same]), 1.0, -1.0))
    return np.asarray(quaternions * signs[:, None])
