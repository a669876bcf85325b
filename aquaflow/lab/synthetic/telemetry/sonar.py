"""The first return of an echo sounder's beam from the true relief and its objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.relief import Area

Array: TypeAlias = npt.NDArray[np.float64]

RINGS = 4
"""Rings of rays around the beam's axis, of 6, 12, 18, ... rays. In a beam of 25 degrees a ray then
points within 1.6 degrees of the nearest point; the range is at most 0.04 % too long."""
STEP_SHARE = 0.6
"""Of the height above the ground by which a ray goes on. In a beam of 25 degrees it thereby shifts
sideways by at most 0.13 of that height and passes nothing that is wider."""
LEAST_STEP_M = 0.01
"""Smallest step of a ray; the range is interpolated within the last one."""


@dataclass(frozen=True)
class Sonar:
    """The ground as an echo sounder meets it: heights at the cells of an area.

    Beyond its area the ground goes on as it is at the border.
    """

    area: Area
    height: npt.NDArray[np.float32]
    """[rows, columns] m up in the survey frame, with the tops of objects."""

    def first_return(
        self,
        origin_s: Array,  # [N, 3] m, survey frame (z down)
        R_sb: Array,  # [N, 3, 3] body in the survey frame; the beam's axis is the body's z
        beam_rad: float,  # full width of the beam
        longest_m: float,
    ) -> Array:
        """[N] m, distance to the nearest ground within the beam; inf where there is none."""
        rays = np.einsum("nij,mj->nmi", R_sb, _cone(0.5 * beam_rad))
        count, per_beam = rays.shape[:2]
        nearest = np.full(count, np.inf)
        ray, beam = rays.reshape(-1, 3), np.repeat(np.arange(count), per_beam)
        origin = origin_s[beam]
        t, gap = np.zeros(len(beam)), self._gap(origin)
        while len(t):
            step = np.maximum(STEP_SHARE * gap, LEAST_STEP_M)
            further = self._gap(origin + (t + step)[:, None] * ray)
            hit = further <= 0.0
            share = gap[hit] / np.maximum(gap[hit] - further[hit], 1e-9)
            np.minimum.at(nearest, beam[hit], t[hit] + share * step[hit])
            t, gap = t + step, further
            # A ray that is already longer than the beam's first return cannot change it.
            live = ~hit & (t < np.minimum(nearest[beam], longest_m))
            t, gap, ray, beam, origin = t[live], gap[live], ray[live], beam[live], origin[live]
        return np.where(nearest <= longest_m, nearest, np.inf)

    def _gap(
        self,
        points: Array,  # [K, 3] m, survey frame
    ) -> Array:
        """[K] m, height above the ground."""
        return np.asarray(-points[:, 2] - self.area.sample(self.height, points[:, :2]))


def _cone(
    half_rad: float,
) -> Array:
    """[M, 3] unit vectors within ``half_rad`` of z."""
    rays = [(0.0, 0.0, 1.0)]
    for ring in range(1, RINGS + 1):
        tilt = half_rad * ring / RINGS
        for k in range(6 * ring):
            turn = 2.0 * math.pi * k / (6 * ring)
            side = math.sin(tilt)
            rays.append((side * math.cos(turn), side * math.sin(turn), math.cos(tilt)))
    return np.array(rays)
