"""A finished map as plain data: Gaussians, cameras, medium, and pictures from any view."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.errors import InputError
from aquaflow.export.map_file import SUFFIX, read_map_file
from aquaflow.export.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians.gaussians import radiance
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.mapping.views import View, in_time
from aquaflow.render import RendererName, select_renderer
from aquaflow.synthetic.water import Medium, Rgb

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
    """Camera to world, map units; camera axes x right, y down, z forward."""


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
    """[H, W] along the ray, map units; meaningless where ``alpha`` is near 0."""


class Map:
    """The map of one sub-map; read it with :func:`load_map`."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self.views: list[MappedView] = [
            MappedView(view.frame_index, view.keyframe, view.camera, view.T_wc)
            for view in in_time(mapper.views)
        ]
        """The mapped frames in the order of the recording."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self._mapper.gaussians)

    @property
    def gaussians(self) -> PlyGaussians:
        """Copies of all Gaussians: world frame, map units, colours without water.

        With a decoder, each Gaussian as the mapped view nearest to it sees it.
        """
        with torch.no_grad():
            plain = self._mapper.scene.baked(self._mapper.views)
            return PlyGaussians(
                means=plain["means"].numpy().copy(),
                wxyz=torch.nn.functional.normalize(plain["quats"], dim=-1).numpy().copy(),
                scales=torch.exp(plain["log_scales"]).numpy(),
                opacities=torch.sigmoid(plain["opacity_logits"][:, 0]).numpy(),
                colours=radiance(plain["raw_colours"]).numpy(),
            )

    @property
    def medium(self) -> Medium | None:
        """The water, mean over the views, with rates per map unit; None if none is modelled."""
        with torch.no_grad():
            waters = [w for view in self._mapper.views if (w := self._mapper.scene.water(view))]
        if not waters:
            return None
        first = waters[0]
        beta_a = torch.stack([water.beta_a for water in waters]).mean(0)
        return Medium(
            beta_a=_rgb(beta_a),
            b=_rgb(first.b),
            B_inf=_rgb(first.B_inf),
            B_res=_rgb(first.B_res),
            d=_rgb(first.d),
        )

    def render(self, T_wc: Sim3, camera: CameraModel | None = None) -> Picture:
        """The map as a camera at ``T_wc`` sees it.

        Args:
            T_wc: camera to world, map units.
            camera: a pinhole camera; distortion is not drawn. The first view's if None is given.

        Raises:
            InputError: no camera is given and the map has no views.
        """
        if camera is None:
            if not self.views:
                raise InputError("the map has no views; give a camera")
            camera = self.views[0].camera
        view = View(0, NO_PIXELS, camera, T_wc, keyframe=0, robust=False)
        shown = self._mapper.show(view)
        return Picture(
            image=shown.image.clamp(0.0, 1.0).numpy(),
            clean=shown.radiance.numpy(),
            alpha=shown.alpha.numpy(),
            range=shown.z.numpy(),
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
        renderer: ``auto`` takes the GPU where gsplat and CUDA are there, else the CPU kernels.
        threads: of the CPU kernels; as many as torch has if None.

    Raises:
        InputError: the file is not there, damaged, or of a newer AquaFlow.
        AquaFlowError: a renderer asked for by name cannot run here.
    """
    file = Path(path)
    if file.is_dir():
        file /= f"map{SUFFIX}"
    return Map(read_map_file(file, select_renderer(renderer, threads)))


def _rgb(
    values: torch.Tensor,  # [3]
) -> Rgb:
    red, green, blue = values.tolist()
    return red, green, blue
