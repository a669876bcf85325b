"""The surface that each view of a map shows: ranges with their sigmas, drawn from the Gaussians.

A pixel's range is the mean over the Gaussians on its ray, weighted as its colour is; the standard
deviation under the same weights is large where two surfaces share a pixel, and such pixels are left
out. With what one pixel of the picture says of a place, it makes the sigma of the range.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import scratch_array
from aquaflow.dive.point_cloud import PosedView
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import activate
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View, in_time
from aquaflow.survey.export.ortho.sightings import FAR, PICTURE_SIGMA_PX
from aquaflow.water.sightings import SOLID

Array = npt.NDArray[np.float64]
Float = npt.NDArray[np.float32]

MOST_SPREAD = 0.1
"""Standard deviation of the ranges within a pixel, over their mean, up to which they are one
surface: nine of ten pixels of the reef. What lies beyond are edges, and far ground in haze."""
LEAST_COSINE = 0.1
"""Between a ray and the surface's normal, 84 degrees: what is seen flatter has a range that changes
by ten pixels' width within one."""
SLOPE_PX = 3
"""Half the distance over which slopes of ranges are taken: over less, single Gaussians show."""
TRUNCATION_SIGMAS = 3.0
"""Distance from its surface, in sigmas of the range, up to which a pixel counts for a place."""
TRUNCATION_VOXELS = (3.0, 6.0)
"""Least and most of it: the least holds all corners of a cell that the surface cuts, with a margin
of a voxel for views that differ; the most is what a block covers."""
RANGE, SIGMA, COSINE = range(3)
"""Layers that are kept of a view, of which NaN as range means none."""
AREA_FOOTPRINTS = 32.0
"""Side of the cells by which the area is known, in what pixels show across: wider than stride and
relief leave holes."""
LEAST_ALPHA = 1e-3
"""Divisor of colours where next to nothing is."""


class ViewSurfaces:
    """Ranges and colours of all views, in the frame and unit of the mesh, in files that end
    with the object."""

    def __init__(
        self,
        views: Sequence[PosedView],
        drawn: Iterable[tuple[Float, Float]],  # [3, H, W] layers and J of each view
        work: Path,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """``drawn``: of each view :func:`drawn_surface`; the files are made in the folder ``work``.

        Raises:
            InputError: the views show nothing, or a file cannot be written.
        """
        self.views = list(views)
        pixels = [view.camera.height * view.camera.width for view in views]
        self._starts = np.concatenate([[0], np.cumsum(pixels)])
        count = int(self._starts[-1])
        self._surface = scratch_array(work, (3 * count,), np.float32)
        self._colours = scratch_array(work, (3 * count,), np.float16)
        for number, (surface, colours) in enumerate(drawn):
            self.surface(number)[:] = surface
            self.radiance(number)[:] = colours
            if progress is not None:
                progress(number + 1, len(self.views))
        self._survey()

    def surface(self, number: int) -> Float:
        """[3, H, W] of a view: range and its sigma in the mesh's unit, cosine of the incidence."""
        return self._of(self._surface, number)

    def radiance(self, number: int) -> npt.NDArray[np.float16]:
        """[3, H, W] of a view: the map's J."""
        return self._of(self._colours, number)

    def _of(
        self,
        flat: npt.NDArray[Any],  # [3 N]
        number: int,
    ) -> npt.NDArray[Any]:
        part = flat[3 * self._starts[number] : 3 * self._starts[number + 1]]
        camera = self.views[number].camera
        return part.reshape(3, camera.height, camera.width)

    def points(self, number: int, stride: int = 1) -> tuple[Array, Array, Array]:
        """What a view shows: points [M, 3], unit normals towards it [M, 3] and sigmas [M]."""
        view, layers = self.views[number], self.surface(number)
        ranges, rays = layers[RANGE].astype(np.float64), unit_rays(view.camera)
        normals = surface_normals(rays, ranges, stride)
        rays, ranges, sigmas = (each[::stride, ::stride] for each in (rays, ranges, layers[SIGMA]))
        with np.errstate(invalid="ignore"):
            kept = (ranges < self.far) & np.isfinite(normals).all(axis=-1)
        points = view.T_uc.apply(rays[kept] * ranges[kept][:, None])
        return points, normals[kept] @ view.T_uc.R.T, sigmas[kept].astype(np.float64)

    def _survey(self) -> None:
        medians, footprints = [], []
        for number, view in enumerate(self.views):
            ranges = self.surface(number)[RANGE]
            seen = ranges[np.isfinite(ranges)]
            if len(seen):
                medians.append(float(np.median(seen)))
                footprints.append(medians[-1] / view.camera.fx)
        if not medians:
            raise InputError("the dive's views show no surface of its map; map the dive again")
        self.median_range = float(np.median(medians))
        """Of all views, in the mesh's unit."""
        self.footprint = float(np.median(footprints))
        """What a picture's pixel shows across, median, in the mesh's unit."""
        self.far = FAR * self.median_range
        """Range beyond which nothing becomes a surface: few pixels show much of it."""
        bounds = np.full((len(self.views), 2, 3), np.inf)
        bounds[:, 1] = -np.inf
        side, cells = AREA_FOOTPRINTS * self.footprint, [np.empty((0, 3))]
        for number, view in enumerate(self.views):
            points = self.points(number, stride=4)[0]
            if len(points):
                cells.append(np.unique(np.floor(points / side), axis=0))
                points = np.vstack([points, view.T_uc.t])
                bounds[number] = points.min(axis=0), points.max(axis=0)
        self._bounds = bounds
        self.area = float(len(np.unique(np.concatenate(cells), axis=0)) * side**2)
        """Of all that is shown, in the mesh's unit squared: to a factor of two."""

    def around(
        self,
        low: Array,  # [3]
        high: Array,  # [3]
    ) -> list[int]:
        """Numbers of the views between whose cameras and surfaces some of the box may lie."""
        first, last = self._bounds[:, 0], self._bounds[:, 1]
        return np.flatnonzero(((first <= high) & (last >= low)).all(axis=1)).tolist()


def truncation(
    sigmas: npt.NDArray[np.floating],  # [...] of ranges
    voxel: float,
) -> Array:
    """[...] distance from a surface within which it counts, in the unit of both."""
    least, most = TRUNCATION_VOXELS
    return np.clip(TRUNCATION_SIGMAS * sigmas, least * voxel, most * voxel)


class NativeSurface(ctypes.Structure):
    """``ViewSurface`` of native/view_surface.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("ranges", "sigmas", "cosines")),
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy")),
        ("R", ctypes.c_double * 9),
        ("t", ctypes.c_double * 3),
        *((name, ctypes.c_double) for name in ("reach_sigmas", "least_reach", "most_reach")),
    )

    @staticmethod
    def of(
        surfaces: ViewSurfaces, number: int, voxel: float, truncations: float = 1.0
    ) -> NativeSurface:
        """Of a view, whose layers it points into; ``truncations`` of them are its reach."""
        view, layers = surfaces.views[number], surfaces.surface(number)
        camera, T_uc = view.camera, view.T_uc
        least, most = (truncations * voxels * voxel for voxels in TRUNCATION_VOXELS)
        native = NativeSurface(
            width=camera.width, height=camera.height,
            fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
            reach_sigmas=truncations * TRUNCATION_SIGMAS, least_reach=least, most_reach=most,
        )  # fmt: skip
        for name, layer in (("ranges", RANGE), ("sigmas", SIGMA), ("cosines", COSINE)):
            setattr(native, name, layers[layer].ctypes.data)
        native.R[:], native.t[:] = T_uc.R.reshape(-1), T_uc.t
        return native


@lru_cache(maxsize=1)
def unit_rays(camera: CameraModel) -> Array:
    """[H, W, 3] directions of the pixels, camera frame; kept, as most views have one camera."""
    rays = camera.unproject(camera.pixel_centres())
    rays = np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    rays.flags.writeable = False
    return rays


def surface_normals(
    rays: Array,  # [H, W, 3] unit
    ranges: Array,  # [H, W]
    stride: int = 1,
) -> Array:
    """Unit normals towards the camera, camera frame, of every ``stride``-th pixel of every
    ``stride``-th row, [ceil(H / stride), ceil(W / stride), 3]; NaN where a neighbour is missing."""
    points, step = rays * ranges[..., None], SLOPE_PX
    height, width = ranges.shape
    first = -(-step // stride) * stride

    def beside(rows: int, columns: int) -> Array:
        return points[
            first + rows : height - step + rows : stride,
            first + columns : width - step + columns : stride,
        ]

    across = np.cross(beside(step, 0) - beside(-step, 0), beside(0, step) - beside(0, -step))
    normals = np.full((-(-height // stride), -(-width // stride), 3), np.nan)
    inner = (slice(first // stride, first // stride + count) for count in across.shape[:2])
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[tuple(inner)] = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return normals


def surfaces_of_map(
    mapper: Mapper, T: Sim3, work: Path, progress: Callable[[int, int], None]
) -> ViewSurfaces:
    """What all views of a map show, in the frame and unit that ``T`` takes its world to.

    Raises:
        InputError: the views show nothing, or a file cannot be written.
    """
    posed = []
    for view in in_time(mapper.views):
        T_wc = T @ view.T_wc
        posed.append(PosedView(view.frame_index, view.camera, Sim3(T_wc.R, T_wc.t)))
    return ViewSurfaces(posed, drawn_surfaces(mapper, T.scale), work, progress)


def drawn_surfaces(mapper: Mapper, unit: float) -> Iterator[tuple[Float, Float]]:
    """:func:`drawn_surface` of every view in the order of time."""
    for view in in_time(mapper.views):
        yield drawn_surface(mapper, view, unit)


@torch.no_grad()
def drawn_surface(mapper: Mapper, view: View, unit: float) -> tuple[Float, Float]:
    """The layers [3, H, W] of a view, lengths in ``unit`` of a map unit, and its J [3, H, W]."""
    shown = mapper.show(view)
    alpha = picture_out(shown.alpha)
    ranges = picture_out(shown.z).astype(np.float64)
    solid = (alpha > SOLID) & picture_out(view.scene_mask()) & (ranges > 0.0)
    spread = _spread(mapper, view, float(np.median(ranges[solid]))) if solid.any() else ranges
    ranges = np.where(solid & (spread <= MOST_SPREAD * ranges), ranges, np.nan)
    sigma = np.hypot(spread, PICTURE_SIGMA_PX / view.camera.fx * ranges)
    colours = picture_out(shown.radiance) / np.maximum(alpha, LEAST_ALPHA)[..., None]
    layers = surface_layers(view.camera, unit * ranges, unit * sigma)
    return layers, np.moveaxis(colours, -1, 0).astype(np.float32)


def surface_layers(
    camera: CameraModel,
    ranges: Array,  # [H, W] NaN: no surface
    sigma: Array,  # [H, W]
) -> Float:
    """[3, H, W] the layers of a view; what is seen too flat is no surface in them."""
    rays = unit_rays(camera)
    cosine = np.abs((surface_normals(rays, ranges) * rays).sum(axis=-1))
    with np.errstate(invalid="ignore"):
        ranges = np.where(cosine >= LEAST_COSINE, ranges, np.nan)
    return np.stack([ranges, sigma, cosine]).astype(np.float32)


def _spread(mapper: Mapper, view: View, middle: float) -> Array:
    """[H, W] standard deviation of the ranges within each pixel, map units. Ranges are drawn as
    differences from ``middle``, whose squares float32 holds."""
    viewmat, renderer = view.viewmat(), mapper.renderer
    plain = mapper.scene.in_sight(view, viewmat)
    drawn = activate(
        plain["means"], plain["log_scales"], plain["opacity_logits"], plain["raw_colours"],
        view.centre(), renderer.threads,
    )  # fmt: skip
    offset = drawn.colours[:, 3] / middle - 1.0
    values = torch.stack([offset, offset**2, torch.zeros_like(offset)], dim=1).contiguous()
    shown = renderer(
        plain["means"], plain["quats"], drawn.scales, drawn.opacities, values,
        viewmat, view.K(), view.camera.width, view.camera.height,
    )  # fmt: skip
    image, alpha = (picture_out(each).astype(np.float64) for each in (shown.image, shown.alpha))
    mean, square = (image[..., layer] / np.maximum(alpha, LEAST_ALPHA) for layer in range(2))
    return np.asarray(middle * np.sqrt(np.maximum(square - mean**2, 0.0)))
