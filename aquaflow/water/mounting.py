"""Lamps as a vehicle carries them: a pair at the camera's sides, brightest where the camera looks.

What they light is nearer to one of them than to the camera, lies off their axis, and faces them or
turns away. All of that changes with range as the water's loss does, by a few per cent: as much as
tells one water from another. It is no part of the water, and known from two things that each patch
of the surface has: the ray on which it is seen, and its normal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

CONE, CONE_SIGMA = -0.2, 0.7
"""Prior: log of the power of the cosine by which the light falls off the axis (Moreno and Sun,
Optics Express 16, 2008). 1 of a bare LED, 0.7 of a beam of 135 degrees, 3 of one of 75."""
LAMBERT, LAMBERT_SIGMA = 0.8, 1.0
"""Prior: logit of the share of Lambert's law in how surface darkens that is lit obliquely. None of
rough ground lit from where it is seen, as of the moon; all of a smooth hull (the lunar-Lambert law,
McEwen, Icarus 92, 1991)."""
ASIDE, ASIDE_SIGMA = -2.3, 0.7
"""Prior: log of how far each lamp is from the middle of both over the median range: 0.1, as 0.2 m
of 2 m."""
CENTRE_SIGMA = 0.05
"""Prior: how far right of and below the camera that middle is, over the median range; around 0."""
START = np.array([CONE, LAMBERT, ASIDE, 0.0, 0.0])
SIGMA = np.array([CONE_SIGMA, LAMBERT_SIGMA, ASIDE_SIGMA, CENTRE_SIGMA, CENTRE_SIGMA])
"""Of the numbers of a mounting, in the order above."""
SHARE_ERROR, PLACE_ERROR = 0.06, np.array([0.06, 0.02])
"""1 sigma that the model adds to what a fit states of the lamp's share, and of the lamps' places to
the right and down, over the median range: root mean square errors on ten rendered dives with lamps,
mapped, where the fit alone states a quarter of them: it is how ground faces them that it misses."""
MOST_LOG = 3.0
"""Guards exponentials: of the cone's power and of the distance aside."""
LEAST_COSINE = 0.01
"""Guards the logarithm of what lies at right angles to the axis."""
RAYS, STEPS, FIRST_STEP = 100, 10, 0.02
"""On which the glow is looked at: rays of the observations, places on each, even in the logarithm
of the distance, and the first of them over the median range."""
NEAREST_LIT = 0.1
"""Share of a lamp's reference range up to which its light is the same: nothing is seen so near."""


@dataclass(frozen=True)
class Lamp:
    """Light from beside the camera on top of the light that is everywhere.

    What is seen at range z gets ``1 - share + share (range / z)^power exp(-beta_a z)`` of the light
    in which J is its colour.
    """

    share: float
    power: float
    range: float
    """In the unit of length that rates are per."""
    share_sigma: float | None = None
    """1 sigma of ``share``; None: not known, as in dives from before 2026-11-27."""
    places: tuple[tuple[float, float], ...] | None = None
    """How far right of and below the camera each of a pair is, in that unit; None: not known."""
    places_sigma: tuple[float, float] | None = None
    """1 sigma of both."""

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Lamp:
        """The lamp that ``dataclasses.asdict`` made them of.

        Raises:
            KeyError, TypeError, ValueError: of these it did not.
        """
        share, power, reference = (float(facts[name]) for name in ("share", "power", "range"))
        sigma, places, apart = (
            facts.get(name) for name in ("share_sigma", "places", "places_sigma")
        )
        return cls(
            share,
            power,
            reference,
            None if sigma is None else float(sigma),
            None if places is None else tuple(_pair(place) for place in places),
            None if apart is None else _pair(apart),
        )

    def beam(
        self,
        beta_a: npt.NDArray[np.floating],  # [3] attenuation
        z: npt.NDArray[np.floating],  # [...]
    ) -> Array:
        """[..., 3] light of the lamp on what is seen at range z."""
        nearer = np.log(self.range) - np.log(np.maximum(z, NEAREST_LIT * self.range))
        return np.asarray(
            self.share * np.exp(self.power * nearer[..., None] - beta_a * z[..., None])
        )

    def light(
        self,
        beta_a: npt.NDArray[np.floating],  # [3] attenuation
        z: npt.NDArray[np.floating],  # [...]
    ) -> Array:
        """[..., 3] all light on what is seen at range z, over that in which J is its colour."""
        return 1.0 - self.share + self.beam(beta_a, z)

    def rescale(self, times: float) -> Lamp:
        """The same lamp in another unit of length, ``times`` of which are one of before."""
        changed = replace(self, range=times * self.range)
        if self.places is None or self.places_sigma is None:
            return changed
        places = tuple((times * right, times * down) for right, down in self.places)
        right, down = self.places_sigma
        return replace(changed, places=places, places_sigma=(times * right, times * down))


def _pair(values: Any) -> tuple[float, float]:
    right, down = (float(value) for value in values)
    return right, down


@dataclass(frozen=True)
class LampLight:
    """A lamp's light on all observations."""

    beam: Array
    """[3, M] what reaches the surface."""
    beam_slopes: Array
    """[5, M] derivatives of its log by the mounting."""
    glow: Array
    """[3, M] what the water returns."""
    glow_slopes: Array
    """[5, M] derivatives of its log by the mounting."""

    @classmethod
    def of_camera(
        cls,
        beam: Array,  # [3, M]
        glow: Array,  # [3, M]
    ) -> LampLight:
        """That of a lamp at the camera that shines everywhere."""
        nothing = np.zeros((len(START), beam.shape[1]))
        return cls(beam, nothing, glow, nothing)


def places_of(
    mounting: Array,  # [5]
    covariance: Array,  # [5, 5]
) -> tuple[tuple[tuple[float, float], ...], tuple[float, float]]:
    """How far right of and below the camera each lamp is, and 1 sigma of both, over the median
    range."""
    aside = float(np.exp(min(mounting[2], MOST_LOG)))
    right, down = mounting[3:].tolist()
    variance = np.maximum(np.diag(covariance), 0.0)
    sigma = np.sqrt([variance[3] + aside**2 * variance[2], variance[4]] + PLACE_ERROR**2)
    return ((right - aside, down), (right + aside, down)), (float(sigma[0]), float(sigma[1]))


class MountedLight:
    """The light of mounted lamps on observations, and what the water returns of it.

    Lengths are over the median range. A mounting is five numbers, as ``START``.
    """

    def __init__(
        self,
        ray: Array,  # [M, 3] unit, camera axes
        normal: Array,  # [M, 3] unit, camera axes
        z: Array,  # [M] range over the median range
        basis: Array,  # [T, M] of the log-gain of the glow over the picture
    ) -> None:
        self._places, self._normal, self._square = ray * z[:, None], normal, z * z
        self._basis = basis
        some = np.linspace(0, len(z) - 1, RAYS).astype(np.int64)
        self._steps = np.geomspace(FIRST_STEP, 1.0, STEPS)
        self._water = (ray[some, None] * self._steps[:, None]).reshape(-1, 3)
        even = np.column_stack([basis[:, some].T, np.ones(len(some))])
        self._to_basis = np.linalg.pinv(even)[:-1]

    def light(
        self,
        mounting: Array,  # [5]
        beam: Array,  # [3, M] of a lamp at the camera
        glow: Array,  # [3, M] of it
    ) -> LampLight:
        """The same lamp's light where it is mounted."""
        direct, direct_slopes = _light(mounting, self._places, self._normal)
        returned, slopes = _light(mounting, self._water, None)
        seen = returned.reshape(-1, STEPS) @ self._steps
        slopes = slopes.reshape(len(slopes), -1, STEPS) @ self._steps / seen
        shape = np.exp(self._to_basis @ np.log(seen) @ self._basis)
        return LampLight(
            beam * direct * self._square,
            direct_slopes / direct,
            glow * shape,
            slopes @ self._to_basis.T @ self._basis,
        )


def _light(
    mounting: Array,  # [5]
    places: Array,  # [N, 3] camera axes
    normal: Array | None,  # [N, 3] unit; None: what faces each lamp
) -> tuple[Array, Array]:
    """[N] mean of both lamps over the square of the distance, and its derivatives [5, N]."""
    cone, aside = np.exp(np.minimum(mounting[[0, 2]], MOST_LOG))
    lambert = 1.0 / (1.0 + np.exp(-mounting[1]))
    total, slopes = np.zeros(len(places)), np.zeros((5, len(places)))
    for side in (-aside, aside):
        way = places - np.array([mounting[3] + side, mounting[4], 0.0])
        square = (way * way).sum(axis=1)
        r = np.sqrt(square)
        cosine = np.maximum(way[:, 2] / r, LEAST_COSINE)
        beam = 0.5 * cosine**cone / square
        facing = np.ones(len(places))
        if normal is not None:
            facing = np.maximum(-(way * normal).sum(axis=1) / r, 0.0)
        light = beam * (1.0 - lambert + lambert * facing)
        total += light
        # By the lamp's place, right and down: nearer, nearer to the axis, and faced more.
        moved = (cone + 2.0) * light / square * way[:, :2].T
        if normal is not None:
            turned = np.where(facing > 0.0, lambert * beam / r, 0.0)
            moved += turned * (normal[:, :2] + (facing / r)[:, None] * way[:, :2]).T
        slopes[0] += cone * np.log(cosine) * light
        slopes[1] += lambert * (1.0 - lambert) * (facing - 1.0) * beam
        slopes[2] += side * moved[0]
        slopes[3:] += moved
    return total, slopes
