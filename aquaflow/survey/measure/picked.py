"""Points that a person picked: a pixel of a mapped picture, a point of the map, a place on earth.

A finished dive keeps its Gaussians and the poses of the mapped views, but no keyframe's depths: a
point of a picture is where its ray meets the map as the renderer draws it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.restored import refuse_outside
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.transfers import map_out, picture_out
from aquaflow.render.views import View
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

RANGE_SIGMA = 0.02
"""Relative 1 sigma of a rendered range: 1.1 to 2.8 % on held-out views
(notes/2026-11-benchmarks.md)."""
CLICK_SIGMA_PX = 1.0
"""1 sigma of a point that a person marked, and of the refined poses."""
LEAST_ALPHA = 0.5
"""Of the map at a point; less is mostly not there."""
WINDOW_PX = 2
"""Half the window that a range is the median of."""
NEIGHBOURS = 8
"""Gaussians around a point of the map, whose size says how well it was picked."""
FARTHEST = 10.0
"""Of the nearest Gaussian from a point of the map, in sizes of its neighbours: beyond, the point is
not of this map."""


@dataclass(frozen=True)
class PixelMeasurement:
    """A point of a picture in the map."""

    place: Array
    """[3] in the world of the sub-map."""
    ray: Array
    """[3] unit, from the camera."""
    range: float
    sigma: float
    """Of the range: of the map anywhere, and by how much it differs around the point."""
    around: float
    """The second part alone."""


@dataclass(frozen=True)
class PickedPoint:
    """A place with what it errs alone and together with its neighbours, in n."""

    place: Array
    """[3]"""
    own: Array
    """[3, 3] covariance."""
    shared: Array
    """[3, 3] covariance."""


def measure_pixels(
    mapper: Mapper,
    view: View,
    pixels: Array,  # [N, 2] px of the mapped picture
) -> list[PixelMeasurement]:
    """Where the rays of pixels meet the map.

    Raises:
        InputError: the map shows nothing there.
    """
    shown = mapper.show(view)
    ranges, alpha = picture_out(shown.z), picture_out(shown.alpha)
    points = []
    for u, v in pixels:
        column, row = int(u), int(v)
        rows = slice(max(0, row - WINDOW_PX), row + WINDOW_PX + 1)
        columns = slice(max(0, column - WINDOW_PX), column + WINDOW_PX + 1)
        solid = alpha[rows, columns] >= LEAST_ALPHA
        if alpha[row, column] < LEAST_ALPHA or not solid.any():
            raise InputError(f"the map shows nothing at {u:g},{v:g}; choose another point")
        near = ranges[rows, columns][solid]
        distance, around = float(np.median(near)), float(np.std(near))
        sigma = float(np.hypot(RANGE_SIGMA * distance, around))
        ray = view.T_wc.R @ view.camera.unproject(np.array([u, v]))
        ray /= np.linalg.norm(ray)
        points.append(PixelMeasurement(view.T_wc.t + distance * ray, ray, distance, sigma, around))
    return points


def of_pixel(
    mapper: Mapper,
    frame: WorldFrame,
    view: View,
    pixel: Array,  # [2] px
) -> PickedPoint:
    """A point of a mapped picture.

    Raises:
        InputError: it is outside of the picture, or the map shows nothing there.
    """
    refuse_outside(view, pixel[None])
    [point] = measure_pixels(mapper, view, pixel[None])
    click = CLICK_SIGMA_PX / view.camera.fx * point.range
    return _picked_point(
        frame, point.place, point.ray, click, point.around, RANGE_SIGMA * point.range
    )


def of_map(
    mapper: Mapper,
    frame: WorldFrame,
    place: Array,  # [3] in n, as map.ply and the viewer have it
) -> PickedPoint:
    """A point of the map; its range error lies along the ray from the nearest mapped view.

    Raises:
        InputError: the map has nothing near it.
    """
    inside = frame.T_nm.inverse().apply(place[None])[0]
    means = map_out(mapper.gaussians.means).astype(np.float64)
    sizes = np.exp(map_out(mapper.gaussians.parameters["log_scales"])).max(axis=1)
    apart = np.linalg.norm(means - inside, axis=1)
    nearest = np.argsort(apart)[:NEIGHBOURS]
    size = float(np.median(sizes[nearest]))
    if apart[nearest[0]] > FARTHEST * size:
        where = ",".join(f"{each:g}" for each in place)
        raise InputError(
            f"the map has nothing at {where}; give x,y,z as map.ply has them, in {frame.unit}"
        )
    centres = np.array([view.T_wc.t for view in mapper.views])
    offset = inside - centres[np.argmin(np.linalg.norm(centres - inside, axis=1))]
    distance = max(float(np.linalg.norm(offset)), size)
    ray = offset / distance
    return _picked_point(frame, inside, ray, size, size, RANGE_SIGMA * distance)


def _picked_point(
    frame: WorldFrame,
    place: Array,  # [3] in the sub-map's world
    ray: Array,  # [3] unit, in the same
    across: float,
    along: float,
    shared: float,
) -> PickedPoint:
    """Sigmas across and along the ray, of the point alone, and along it, of its neighbourhood."""
    T = frame.T_nm
    direction = T.R @ ray
    along_ray = np.outer(direction, direction)
    own = across**2 * (np.eye(3) - along_ray) + along**2 * along_ray
    return PickedPoint(
        T.apply(place[None])[0], T.scale**2 * own, (T.scale * shared) ** 2 * along_ray
    )
