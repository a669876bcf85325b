"""A flight through the map of a dive, along the camera's way but smooth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.dive.dive import Dive
from aquaflow.dive.map_splats import splats_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import checkpoint_in, picture_out
from aquaflow.render.views import View, in_time
from aquaflow.survey.export.ortho.colours import Colours
from aquaflow.survey.video.encoder import check_name, video_file
from aquaflow.survey.video.smooth_path import smooth_path

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
    range from which the nearest view saw it (:mod:`aquaflow.survey.export.ortho.colours`).

    Raises:
        InputError: the dive has no map, or the file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    check_name(path)
    mapper = dive.map()
    views = in_time(mapper.views)
    count = max(round(seconds * FPS), 2)
    knots = max(round(seconds / SECONDS_PER_KNOT), LEAST_KNOTS)
    camera = resized(views[0].camera, width)
    draw = Through(mapper, camera) if water else Clear(mapper, camera)
    with video_file(path, FPS) as file:
        for done, pose in enumerate(smooth_path([v.T_wc for v in views], count, knots), start=1):
            file.add(draw(pose))
            if progress is not None:
                progress(done, count)
    return count


def resized(camera: CameraModel, width: int | None) -> CameraModel:
    """The camera for pictures ``width`` px wide, of the same shape; None: as it is."""
    if width is None:
        return camera
    return camera.scaled(width, round(camera.height * width / camera.width))


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

        def sent(values: npt.NDArray[np.floating]) -> torch.Tensor:  # [N, ...]
            return checkpoint_in(np.ascontiguousarray(values, np.float32), device)

        self._means, self._wxyz, self._scales = map(
            sent, (splats.means, splats.wxyz, splats.scales)
        )
        self._opacities, self._colours = sent(splats.opacities), sent(bounded[:, 0] / 255.0)

    @torch.no_grad()
    def __call__(self, T_wc: Sim3) -> Picture:
        """[H, W, 3] from a pose."""
        camera, blank = self._camera, np.zeros((1, 1, 3), np.uint8)
        view = View(-1, blank, camera, T_wc, 0, False, device=self._mapper.device)
        drawn = self._mapper.renderer(
            self._means, self._wxyz, self._scales, self._opacities, self._colours,
            view.viewmat(), view.K(), camera.width, camera.height,
        )  # fmt: skip
        return to_bytes(picture_out(drawn.image))
