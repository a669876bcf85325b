"""What some views of a map show: points of the ground, its mean plane, and open water.

Where gravity is unknown, that plane gives the world frame n its vertical, once, at the dive's end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import nearest_rotation
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View
from aquaflow.telemetry.ground_plane import down_into_ground
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.sightings import AGREEING, SOLID

Array = npt.NDArray[np.float64]

OPEN = -1.0
"""In place of a range: the view shows open water."""
MOST_VIEWS = 30
"""That are drawn, spread over the dive."""
STRIDE_PX = 8
"""Between the pixels that are taken of a view."""
CHUNK = 1 << 16
"""Places that are looked up at a time; some 10 MB."""
REACH = 3.0
"""Times the median range of a view up to which what it shows counts: what is farther is drawn from
a ninth of the pixels."""


@dataclass(frozen=True)
class ShownPoints:
    """Points of the map that a view shows; nothing of them is open water."""

    places: Array
    """[M, 3] in the world of the sub-map."""
    ranges: Array
    """[M] from the view, map units."""


def solid_ranges(mapper: Mapper, view: View) -> npt.NDArray[np.float32]:
    """[H, W] range of the map from the view, map units; 0 where it is not solid, OPEN where the map
    shows open water there, as by :meth:`aquaflow.mapping.scene.Scene.open_water`."""
    shown = mapper.show(view)
    z = np.where(picture_out(shown.alpha) > SOLID, picture_out(shown.z), np.float32(0.0))
    if mapper.medium.active:
        is_open = mapper.scene.open_water(view, shown.image.contiguous(), shown)
        z = np.where(picture_out(is_open), np.float32(OPEN), z)
    return z


class ShownViews:
    """At most MOST_VIEWS views of a map; drawn once, when it is first asked what they show."""

    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper
        self._views = mapper.views[:: max(1, len(mapper.views) // MOST_VIEWS)]

    @cached_property
    def _ranges(self) -> list[npt.NDArray[np.float32]]:
        return [solid_ranges(self.mapper, view) for view in self._views]

    def points(self) -> list[ShownPoints]:
        """Of each view that shows some."""
        found = []
        for view, whole in zip(self._views, self._ranges, strict=True):
            z = whole[::STRIDE_PX, ::STRIDE_PX].astype(np.float64)
            if not (z > 0.0).any():
                continue
            near = (z > 0.0) & (z < REACH * np.median(z[z > 0.0]))
            rays = view.camera.unproject(view.camera.pixel_centres()[::STRIDE_PX, ::STRIDE_PX])
            unit = rays[near] / np.linalg.norm(rays[near], axis=-1, keepdims=True)
            found.append(ShownPoints(view.T_wc.apply(unit * z[near][:, None]), z[near]))
        return found

    def in_open_water(
        self,
        places: npt.NDArray[np.floating[Any]],  # [N, 3] in the world of the sub-map
    ) -> npt.NDArray[np.bool_]:
        """[N] True for places where more views show open water than a surface of the map."""
        parts = range(0, len(places), CHUNK)
        votes = [self._votes(places[first : first + CHUNK].astype(np.float64)) for first in parts]
        return np.concatenate([np.zeros(0, np.int32), *votes]) > 0

    def _votes(
        self,
        places: Array,  # [N, 3] in the world of the sub-map
    ) -> npt.NDArray[np.int32]:
        """[N] views that show open water there, less those that show a surface."""
        votes = np.zeros(len(places), np.int32)
        for view, z in zip(self._views, self._ranges, strict=True):
            local = (places - view.T_wc.t) @ view.T_wc.R
            ahead = np.flatnonzero(local[:, 2] > 0.0)
            u, v = np.floor(view.camera.project(local[ahead])).T
            inside = (u >= 0) & (u < view.camera.width) & (v >= 0) & (v < view.camera.height)
            ahead = ahead[inside]
            shown = z[v[inside].astype(np.intp), u[inside].astype(np.intp)]
            ranges = np.linalg.norm(local[ahead], axis=1)
            votes[ahead[shown < 0.0]] += 1
            votes[ahead[np.abs(shown - ranges) <= AGREEING * ranges]] -= 1
        return votes


def on_ground(frame: WorldFrame, mapper: Mapper) -> WorldFrame:
    """The frame of a map with z into the ground and x to the top of the first picture, where
    gravity is unknown and the views look squarely at the mean plane of what they show; else the
    frame as it is, and so that of an earlier dive. Every view has the same weight, however much of
    it shows the map."""
    if frame.has_vertical or frame.site or not mapper.views or not len(mapper.gaussians):
        return frame
    shown = ShownViews(mapper).points()
    if not shown:
        return frame
    places = np.concatenate([each.places for each in shown])
    weights = np.concatenate([np.full(len(each.places), 1.0 / len(each.places)) for each in shown])
    looks = np.array([view.T_wc.R[:, 2] for view in mapper.views])
    down = down_into_ground(places, weights, looks)
    if down is None:
        return frame
    # A survey's lines go there and back, so that only the first picture's top is sure to exist.
    first = min(mapper.views, key=lambda view: view.frame_index)
    x = -first.T_wc.R[:, 1]
    x = x - down * (down @ x)
    x /= np.linalg.norm(x)
    R = nearest_rotation(np.array([x, np.cross(down, x), down]))
    return replace(frame.turn(R @ frame.T_nm.R.T), on_ground=True)
