"""What some views of a map show: points of the ground, its mean plane, and open water.

Where gravity is unknown, that plane gives the world frame n its vertical, once, at the dive's end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import nearest_rotation
from aquaflow.mapping.mapper import Mapper
from aquaflow.optimise.robust import Cauchy, sigma_of
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.sightings import AGREEING, SOLID

Array = npt.NDArray[np.float64]

OPEN = -1.0
"""In place of a range: the view shows open water."""
MOST_VIEWS = 30
"""That are drawn, spread over the dive."""
STRIDE_PX = 8
"""Between the pixels that are taken of a view."""
REACH = 3.0
"""Times the median range of a view up to which what it shows counts: what is farther is drawn from
a ninth of the pixels."""
ROUNDS = 10
"""Of weighted fits; five or six leave less than 0.1 degrees."""
KERNEL = Cauchy(2.4)
"""Of distances from the plane."""
LARGEST_RELIEF = 0.5
"""Thickness of what has a plane, over its lesser width, both as standard deviations: judgement.
The ground of the surveys 1, 3, 6 and 7 has 0.07 to 0.19, an even ball has 1."""
LARGEST_LOOK_DEG = 30.0
"""Between the cameras' viewing directions, by their mean cosine, and the normal of what they show,
up to which that plane is taken for the ground, seen squarely. The mean direction of the surveys 1,
3, 6 and 7, which look down, has 14, 4, 2 and 10; that of the reef clip, which looks ahead, 61."""


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
        places: Array,  # [N, 3] in the world of the sub-map
    ) -> npt.NDArray[np.bool_]:
        """[N] True for places where more views show open water than a surface of the map."""
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
        return votes > 0


def mean_normal(shown: Sequence[ShownPoints]) -> Array | None:
    """[3] unit normal of the plane that the points lie about, of either sign; None where they lie
    about none. Every view has the same weight, however much of it shows the map."""
    if not shown:
        return None
    points = np.concatenate([each.places for each in shown])
    equal = np.concatenate([np.full(len(each.places), 1.0 / len(each.places)) for each in shown])
    weights = equal
    for _ in range(ROUNDS):
        offset = points - np.average(points, axis=0, weights=weights)
        spread, axes = np.linalg.eigh((weights[:, None] * offset).T @ offset / weights.sum())
        across = offset @ axes[:, 0]
        weights = equal * KERNEL.weight(across / max(sigma_of(across), 1e-12))
    if spread[0] > LARGEST_RELIEF**2 * spread[1]:
        return None
    return np.asarray(axes[:, 0])


def on_ground(frame: WorldFrame, mapper: Mapper) -> WorldFrame:
    """The frame of a map with z into the ground and x to the top of the first picture, where
    gravity is unknown and the views look squarely at the mean plane of what they show; else the
    frame as it is, and so that of an earlier dive."""
    if frame.level or frame.site or not mapper.views or not len(mapper.gaussians):
        return frame
    down = mean_normal(ShownViews(mapper).points())
    if down is None:
        return frame
    look = np.mean([view.T_wc.R[:, 2] for view in mapper.views], axis=0)
    down = down * np.sign(down @ look)
    if down @ look < np.cos(np.radians(LARGEST_LOOK_DEG)):
        return frame
    # A survey's lines go there and back, so that only the first picture's top is sure to exist.
    first = min(mapper.views, key=lambda view: view.frame_index)
    x = -first.T_wc.R[:, 1]
    x = x - down * (down @ x)
    x /= np.linalg.norm(x)
    R = nearest_rotation(np.array([x, np.cross(down, x), down]))
    return replace(frame.turn(R @ frame.T_nm.R.T), on_ground=True)
