"""Light of the vehicle's own lamps: on the surface, and scattered back on the way.

What the camera sees of a surface is J (ambient + E) exp(-beta_a z), with J its radiance in full
daylight, and E what the lamps add to the light on it. A lamp is a point whose intensity falls off
its axis as a power of the cosine, as that of an LED does (Moreno and Sun, "Modeling the radiation
pattern of LEDs", Optics Express 16, 2008); E falls with the square of the distance, with
exp(-beta_a r) on the way to the surface, and with the cosine at which the light meets it (Lambert).
The water between scatters the lamps' light once, back along the ray (McGlamery, "A computer model
for underwater camera systems", SPIE 208, 1980; Jaffe, "Computer modeling and the design of optimal
underwater imaging systems", IEEE J. Oceanic Eng. 15, 1990).

Left out: light that is scattered forward on the way, and what lamps beside the camera leave in
shadow. Shade of daylight is taken for paint of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import Lamps
from aquaflow.lab.synthetic.water import Medium

Array: TypeAlias = npt.NDArray[np.floating]

SCATTERED_SHARE = 0.7
"""Scattering over attenuation (single scattering albedo): 0.6 to 0.8 in coastal water."""
BACKWARD_PER_SR = 0.003
"""Phase function near 180 degrees, 1 / sr: Petzold's mean particle, which hardly changes beyond 120
degrees (Mobley, Light and Water, 1994, table 3.10; quoted from memory)."""
NEAREST_M, FARTHEST_M = 0.02, 30.0
"""Of the water that scatters: the port, and where the light is spent in any water of the table."""
STEPS = 8
"""Along a ray, even in the logarithm of the distance; 64 change a picture by 0.02 grey levels."""


@dataclass(frozen=True)
class SyntheticLampLight:
    """The lamps of a vehicle in one water, where they are now; in any frame, m."""

    lamps: Lamps
    medium: Medium
    places: Array
    """[L, 3]"""
    axis: Array
    """[3] unit, where they shine."""

    @classmethod
    def of_camera(
        cls,
        lamps: Lamps,
        medium: Medium,
        R: Array,  # [3, 3] camera axes in the frame
        centre: Array,  # [3] m, of the camera in the frame
    ) -> SyntheticLampLight:
        """The lamps as they are mounted around a camera."""
        places = centre + np.asarray(lamps.places_m) @ R.T
        return cls(lamps, medium, places.astype(np.float32), R[:, 2].astype(np.float32))

    def compose(
        self,
        J: Array,  # [N, 3] radiance in full daylight
        start: Array,  # [3] or [N, 3] m, where the rays begin
        rays: Array,  # [N, 3] unit
        t: Array,  # [N] m, inf where nothing is hit
        normals: Array,  # [N, 3] unit, of what is hit
    ) -> Array:
        """The colour [N, 3] that reaches the camera."""
        hit = np.isfinite(t)
        points = start + np.where(hit, t, 0.0).astype(np.float32)[:, None] * rays
        ambient = np.float32(self.lamps.ambient)
        facing = np.where((normals * rays).sum(axis=-1, keepdims=True) > 0.0, -normals, normals)
        light = np.where(hit[:, None], ambient + self._irradiance(points, facing), 0.0)
        direct = J * light * self.medium.transmission(t)
        scattered = ambient * self.medium.backscatter(t) + self._veil(start, rays, t)
        return np.asarray(direct + scattered, np.float32)

    def _irradiance(
        self,
        points: Array,  # [N, 3] m
        normals: Array | None = None,  # [N, 3] unit; None: of a surface that faces each lamp
    ) -> Array:
        """[N, 3] over that of full daylight."""
        total = np.zeros((len(points), 3), np.float32)
        for place in self.places:
            way = points - place
            r = np.maximum(np.sqrt((way * way).sum(axis=-1)), np.float32(NEAREST_M))
            way /= r[:, None]
            lit = np.maximum(way @ self.axis, 0.0) ** np.float32(self.lamps.cosine_power) / r**2
            if normals is not None:
                lit *= np.maximum(-(way * normals).sum(axis=-1), 0.0)
            total += lit[:, None] * self.medium.transmission(r)
        share = (1.0 - self.lamps.ambient) * self.lamps.even_m**2 / len(self.places)
        return total * np.asarray(self.lamps.colour, np.float32) * np.float32(share)

    def _veil(
        self,
        start: Array,  # [3] or [N, 3] m
        rays: Array,  # [N, 3] unit
        t: Array,  # [N] m
    ) -> Array:
        """[N, 3] light of the lamps that the water returns before ``t``."""
        end = np.minimum(t, np.float32(FARTHEST_M))
        span = np.log(np.maximum(end / np.float32(NEAREST_M), 1.0))
        total = np.zeros((len(rays), 3), np.float32)
        for k in range(STEPS):
            s = np.float32(NEAREST_M) * np.exp(span * np.float32((k + 0.5) / STEPS))
            lit = self._irradiance(start + s[:, None] * rays)
            total += (s * span)[:, None] * lit * self.medium.transmission(s)
        # A white surface returns a pi-th of its irradiance per steradian; J is in that unit.
        returned = np.pi * BACKWARD_PER_SR * SCATTERED_SHARE * np.array(self.medium.beta_a)
        return total * (returned / STEPS).astype(np.float32)
