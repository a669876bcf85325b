"""A finished map as plain data: Gaussians, cameras, medium, and pictures from any view."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.dive.map_file import SUFFIX, read_map_file, splats_of
from aquaflow.dive.medium import Medium, Rgb
from aquaflow.dive.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.render import RendererName, select_renderer
from aquaflow.render.transfers import picture_out, water_out
from aquaflow.render.views import View, in_time
from aquaflow.telemetry.metric_file import read_frame_of_map
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    pass

FloatImage = npt.NDArray[np.float32]


@dataclass(frozen=True)
class MappedView:
    """A frame that the map was made from."""

    frame_index: int
    """Position in the recording."""
    keyframe: int
    """Number of the keyframe that its pose hangs on."""
    camera: CameraModel
    """Pixels."""
    T_wc: Sim3
    """Camera to world, rigid, in the map's unit; camera axes x right, y down, z forward."""


@dataclass(frozen=True)
class Picture:
    """The map from one view."""

    image: FloatImage
    """[H, W, 3] RGB in [0, 1], through the water, in the dive's mean exposure and even light."""
    clean: FloatImage
    """[H, W, 3] RGB radiance without water; premultiplied by ``alpha``."""
    alpha: FloatImage
    """[H, W] in [0, 1]: how much of each pixel the map covers."""
    range: FloatImage
    """[H, W] along the ray, in the map's unit; meaningless where ``alpha`` is near 0."""


class Map:
    """The map of one sub-map; read it with :func:`load_map`.

    World and unit of length are those of the dive's other files: n (docs/conventions.md#world-n),
    and metres where they are known, else map units.
    """

    def __init__(self, mapper: Mapper, metric_frame: WorldFrame | None = None) -> None:
        self._mapper = mapper
        self.metric_frame = metric_frame or WorldFrame.unknown()
        """What the world is, how well that is known, and from which telemetry."""
        self.views: list[MappedView] = [
            MappedView(view.frame_index, view.keyframe, view.camera, self._pose(view.T_wc))
            for view in in_time(mapper.views)
        ]
        """The mapped frames in the order of the recording."""

    @property
    def unit(self) -> str:
        """Unit of lengths: ``m`` or ``map units``."""
        return self.metric_frame.unit

    def _pose(self, T_mc: Sim3) -> Sim3:
        T_nc = self.metric_frame.pose(T_mc)
        return Sim3(T_nc.R, T_nc.t)

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self._mapper.gaussians)

    @property
    def gaussians(self) -> PlyGaussians:
        """Copies of all Gaussians: world frame, the map's unit, colours without water.

        With a decoder, each Gaussian as the mapped view nearest to it sees it.
        """
        splats = splats_of(self._mapper)
        frame = self.metric_frame
        return splats if frame.is_identity else splats.transform(frame.T_nm)

    @property
    def medium(self) -> Medium | None:
        """The water, mean over the views, with rates per unit, and the light of the vehicle's own
        lamp; None if none is modelled."""
        with torch.no_grad():
            waters = [w for view in self._mapper.views if (w := self._mapper.scene.water(view))]
        if not waters:
            return None
        first, scale = waters[0], self.metric_frame.T_nm.scale
        beta_a = torch.stack([water.beta_a for water in waters]).mean(0)
        return Medium(
            beta_a=_rgb(beta_a / scale),
            b=_rgb(first.b / scale),
            B_inf=_rgb(first.B_inf),
            B_res=_rgb(first.B_res),
            d=_rgb(first.d / scale),
            lamp=first.lamp and first.lamp.rescale(scale),
        )

    def render(self, T_wc: Sim3, camera: CameraModel | None = None) -> Picture:
        """The map as a camera at ``T_wc`` sees it.

        Args:
            T_wc: camera to world, in the map's unit.
            camera: a pinhole camera; distortion is not drawn. The first view's if None is given.

        Raises:
            InputError: no camera is given and the map has no views.
        """
        if camera is None:
            if not self.views:
                raise InputError("the map has no views; give a camera")
            camera = self.views[0].camera
        T_nm = self.metric_frame.T_nm
        T_mc = T_wc if self.metric_frame.is_identity else T_nm.inverse() @ T_wc
        view = View(0, NO_PIXELS, camera, T_mc, keyframe=0, robust=False)
        shown = self._mapper.show(view)
        return Picture(
            image=picture_out(shown.image.clamp(0.0, 1.0)),
            clean=picture_out(shown.radiance),
            alpha=picture_out(shown.alpha),
            range=picture_out(shown.z * T_nm.scale),
        )


def load_map(
    path: str | os.PathLike[str],
    *,
    renderer: RendererName = "auto",
    threads: int | None = None,
) -> Map:
    """Read the map of a dive: ``path`` is the dive folder, or one of its ``map*.aqf``.

    Args:
        path: a folder stands for its ``map.aqf``, the largest sub-map.
        renderer: ``auto`` takes the fastest that draws here, on a GPU or the processor.
        threads: of the CPU kernels; as many as torch has if None.

    Raises:
        InputError: the dive is not finished; or the file, or the dive's metric.json, is damaged or
            of a newer AquaFlow; or the file is not there.
        AquaFlowError: a renderer asked for by name cannot run here.
    """
    file = Path(path)
    if file.is_dir():
        file /= f"map{SUFFIX}"
    elif file.is_symlink():  # the user's own
        file = file.resolve()
    refuse_unfinished(file.parent)
    return Map(read_map_file(file, select_renderer(renderer, threads)), read_frame_of_map(file))


def _rgb(
    values: torch.Tensor,  # [3]
) -> Rgb:
    red, green, blue = water_out(values).tolist()
    return red, green, blue
