"""A dive's map as a scene to take pictures of: its Gaussians without water, from any place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.base.errors import InputError
from aquaflow.dive.map_file import read_map_file
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.training.correspondences import correspondences
from aquaflow.lab.training.pair_generator.render import BRIGHTEST, median_depth
from aquaflow.lab.training.pairs import Pair, ViewBatch, joined_views
from aquaflow.mapping.scene import show
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.render import select_renderer
from aquaflow.render.views import View, in_time

SHOWN, COVERED = 0.5, 0.9
"""Alpha from which a pixel shows the map and not open water, and from which it has a range."""
FINEST = 4
"""Pixels along a side of one, at most, that are drawn and averaged: a Gaussian is never smaller
than a pixel, and would look larger in a picture that is coarser than those it was made from."""
NEIGHBOURS = 12
"""Mapped views, the nearest ones, that are asked whether they saw what is drawn."""
WITNESSES = 2
"""Of them that must have, at the same range: what one saw alone may be anywhere on its ray."""
REAL_WIDTH = 160
"""px of the ranges that the mapped views are asked for."""


class MappedScene:
    """The map of a finished dive."""

    def __init__(self, map_file: Path) -> None:
        """Read ``map_file``.

        Raises:
            InputError: it is no map, or none of more than WITNESSES views.
        """
        # The CPU's renderer everywhere, so that a seed gives the same pairs everywhere.
        self._mapper = read_map_file(map_file, select_renderer("cpu"))
        self._mapped = in_time(self._mapper.views)
        if len(self._mapped) <= WITNESSES or len(self._mapper.gaussians) == 0:
            raise InputError(f"the map {map_file} has too few views to learn from; leave it out")
        self.T_wc = torch.stack([_matrix(view.T_wc) for view in self._mapped])
        """[V, 4, 4] the mapped views' cameras to world."""
        self.camera: CameraModel = self._mapped[0].camera
        self._seen: dict[int, ViewBatch] = {}

    def view(
        self,
        K: Tensor,  # [1, 3, 3] px
        T_wc: Tensor,  # [1, 4, 4]
        width: int,
        height: int,
    ) -> ViewBatch:
        """The map's radiance, valid where it is solid and mapped views saw it at that range."""
        drawn = self._draw(K, T_wc, width, height)
        away = (self.T_wc[:, :3, 3] - T_wc[0, :3, 3]).norm(dim=1)
        nearest = away.argsort(stable=True)[:NEIGHBOURS].tolist()
        witnesses = joined_views([self.render_mapped(number) for number in nearest])
        repeated = joined_views([drawn] * len(nearest))
        seen = correspondences(Pair(repeated, witnesses)).visible.sum(0) >= WITNESSES
        return ViewBatch(drawn.image, drawn.depth, K, T_wc, drawn.valid & seen[None])

    def render_mapped(self, number: int) -> ViewBatch:
        """The map as drawn from a mapped view, valid where it is solid."""
        if number not in self._seen:
            real = self._mapped[number].camera
            width, height = REAL_WIDTH, round(REAL_WIDTH * real.height / real.width)
            K = torch.from_numpy(real.scaled(width, height).K).float()[None]
            self._seen[number] = self._draw(K, self.T_wc[number][None], width, height)
        return self._seen[number]

    def depth(
        self,
        number: Tensor,  # [1] int64
    ) -> Tensor:
        """[1] median of what a mapped view sees."""
        return median_depth(self.render_mapped(int(number)))

    @torch.no_grad()
    def _draw(
        self,
        K: Tensor,  # [1, 3, 3] px
        T_wc: Tensor,  # [1, 4, 4]
        width: int,
        height: int,
    ) -> ViewBatch:
        finer = min(max(round(self.camera.fx / float(K[0, 0, 0])), 1), FINEST)
        fx, fy, cx, cy = (finer * K[0, [0, 1, 0, 1], [0, 1, 2, 2]]).tolist()
        camera = CameraModel(finer * width, finer * height, fx, fy, cx, cy)
        pose = T_wc[0].double().numpy()
        view = View(0, NO_PIXELS, camera, Sim3(pose[:3, :3], pose[:3, 3]), keyframe=0, robust=False)
        scene, viewmat = self._mapper.scene, view.viewmat()
        shown = show(scene.seen_from(view, viewmat), None, None, scene.renderer, view, viewmat)
        rays = camera.unproject(camera.pixel_centres())
        z = shown.z / torch.from_numpy(np.linalg.norm(rays, axis=-1)).float()
        layers = [scene.apply_white_balance(shown.radiance), shown.alpha[..., None]]
        layers.append((shown.alpha * z)[..., None])
        layers_chw = torch.cat(layers, -1).permute(2, 0, 1)[None]
        averaged = F.avg_pool2d(layers_chw, finer)
        image, alpha, depth = averaged[:, :3], averaged[:, 3:4], averaged[:, 4:]
        solid = alpha > SHOWN
        image = torch.where(solid, image / alpha.clamp_min(SHOWN), 0.0).clamp(0.0, BRIGHTEST)
        depth = torch.where(solid, depth / alpha.clamp_min(SHOWN), 0.0)[:, 0]
        return ViewBatch(image, depth, K, T_wc, (alpha[:, 0] > COVERED) & (depth > 0.0))


def _matrix(T: Sim3) -> Tensor:
    """[4, 4]"""
    matrix = torch.eye(4)
    matrix[:3, :3], matrix[:3, 3] = torch.from_numpy(T.R), torch.from_numpy(T.t)
    return matrix
