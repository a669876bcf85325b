"""A finished map as plain data: Gaussians, cameras, medium, and pictures from any view."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.config.presets import load_configured
from aquaflow.dive.dive import Dive, read_dive
from aquaflow.dive.map_file import SUFFIX, read_map_file, splats_of
from aquaflow.dive.medium import Medium, Rgb
from aquaflow.dive.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.render import RendererName, select_renderer
from aquaflow.render.transfers import picture_out, water_out
from aquaflow.render.views import View, in_time
from aquaflow.sources import RecordedCamera, open_recording
from aquaflow.sources.newest import open_telemetry
from aquaflow.telemetry.metric_file import read_frame_of_map
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.dive.replay import Progress

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

    World and unit of length are those of the dive's other files: n and metres where telemetry gave
    them, else the first keyframe's camera and map units.
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
        """Of lengths: ``m`` or ``map units``."""
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
        """The water, mean over the views, with rates per unit; None if none is modelled."""
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
        renderer: ``auto`` takes the GPU where gsplat and CUDA are there, else the CPU kernels.
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


# --------------------------------------------------------------------------------------------------
# Mapping a recording from Python, as ``aquaflow map`` does it on the command line.


def map_recording(
    source: str | os.PathLike[str] | RecordedCamera,
    out: str | os.PathLike[str],
    *,
    calibration: str | os.PathLike[str] | CameraModel | None = None,
    config: str | os.PathLike[str] | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    telemetry: Sequence[str | os.PathLike[str]] = (),
    telemetry_offset_s: float | None = None,
    in_site: str | os.PathLike[str] | None = None,
) -> Dive:
    """Map a recording into the dive folder ``out`` and read what came of it.

    torch, OpenCV and BLAS get the number of threads that the config asks for, in this whole
    process: results repeat bit for bit at a given number.

    Args:
        source: a video, a folder of pictures, an MCAP recording, a ROS bag, a synthetic dive, or
            a camera of your own that is already open.
        out: folder to write; the report and the map files are in it afterwards.
        calibration: a ``camera.yaml`` or the camera itself; else the one that comes with the
            recording, else a guess that is refined.
        config: a YAML file of settings, see ``aquaflow config``.
        preset: ``fast``, ``balanced`` or ``accurate``, on top of ``config``.
        settings: single settings on top of both, nested as in the YAML file, such as
            ``{"source": {"every": 2}}``.
        overwrite: replace a dive that ``out`` holds already.
        progress: called with the stage, the steps done and the number of steps (None: unknown).
        telemetry: logs that were recorded with ``source``, beside the telemetry in it.
        telemetry_offset_s: when these logs begin, s after the first picture; None: it is found
            from the rotations that the logs and the poses have in common.
        in_site: an earlier dive, in whose frame this one goes on once it is recognised there.

    Raises:
        InputError: the recording cannot be read or the folder cannot be written.
        ConfigError: a setting is unknown or out of range, or does not fit the pictures.
        NotMappedError: the frames were read but gave no map; the folder says why.
    """
    file = None if config is None else Path(config)
    chosen = load_configured(file, preset, dict(settings or {}), "settings")
    camera = calibration
    if camera is not None and not isinstance(camera, CameraModel):
        camera = load_camera(Path(camera))
    if isinstance(source, (str, os.PathLike)):
        recording, name = open_recording(Path(source), fps=chosen.source.fps), Path(source).name
    else:
        recording, name = source, type(source).__name__
    path = Path(source) if isinstance(source, (str, os.PathLike)) else None
    given = open_telemetry(path, [Path(log) for log in telemetry], telemetry_offset_s)
    from aquaflow.tracking.base import base_of

    base = None if in_site is None else base_of(Path(in_site))
    from aquaflow.dive import replay  # loads torch: after what can be refused without it

    replay.map_recording(
        recording, name, Path(out), chosen, camera, overwrite, progress, telemetry=given,
        base=base,
    )  # fmt: skip
    return read_dive(out)
