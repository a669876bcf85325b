"""Whole dives as the water's fit sees them: observations of a scene of patches, by drawn water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.water import WATER_TYPES
from aquaflow.water.model import shading_basis
from aquaflow.water.observations import Observations

Array = npt.NDArray[np.float64]

POINTS, VIEWS, SEEN_BY = 700, 12, 6
PATCHES = 30
"""Of the scene, alike in themselves: sand, coral, rock."""
LIGHT_SIGMA = 0.03
"""Log brightness of a patch in one view: caustics, the map's errors, what shading is left."""
DRAWN = ("oceanic_IB", "oceanic_II", "coastal_1C", "coastal_3C", "coastal_5C")


@dataclass(frozen=True)
class Kind:
    """What all dives of one row of a table share."""

    span: float
    """Largest over smallest range of one point, at the most."""
    noise: float
    """Of one observation, the mean over a patch, of full scale: 0.005 on Curasao, 0.008 on IUI3,
    0.02 on the reef in its playing light."""
    exposure: float
    """Deviation of the log-gain of a view."""
    water: bool = True


@dataclass(frozen=True)
class Dive:
    """Observations, and what lies between them and the scene."""

    seen: Observations
    beta_a: Array
    """[3] per map unit; the median range is about one unit."""
    B_inf: Array
    """[3]"""


def dive(kind: Kind, seed: int) -> Dive:
    """A camera swims over patches of ground, and sees each point from several ranges."""
    random = np.random.default_rng(seed)
    positions, J = _scene(random)
    beta, b, B_inf = _water(random) if kind.water else np.zeros((3, 3))
    first = random.integers(0, VIEWS - SEEN_BY + 1, POINTS)
    point = np.repeat(np.arange(POINTS), SEEN_BY)
    view = (first[:, None] + np.arange(SEEN_BY)).reshape(-1)
    nearing = np.linspace(0.5, -0.5, SEEN_BY) + 0.1 * random.normal(size=(POINTS, SEEN_BY))
    middle = np.exp(0.3 * random.normal(size=POINTS)) + 0.15 * positions[:, 1]
    z = (middle[:, None] * kind.span ** nearing.clip(-0.5, 0.5)).reshape(-1)
    across = random.uniform(-0.95, 0.95, len(z))
    down = np.clip(1.2 - z + 0.3 * random.normal(size=len(z)), -0.95, 0.95)
    xy = np.stack([across, down], axis=-1)

    path = z[:, None]
    colour = J[point] * np.exp(-beta * path) - B_inf * np.expm1(-b * path)
    gains = kind.exposure * random.normal(size=(VIEWS, 1)) + 0.03 * random.normal(size=(VIEWS, 3))
    colour *= np.exp(gains - gains.mean(axis=0))[view] if kind.exposure else 1.0
    colour *= np.exp(shading_basis(xy) @ np.array([0.0, 0.0, -0.15, 0.0, -0.15]))[:, None]
    patch = _patch_of(positions)[point]
    colour *= np.exp(LIGHT_SIGMA * random.normal(size=(PATCHES, VIEWS)))[patch, view][:, None]
    noisy = colour + kind.noise * random.normal(size=colour.shape)
    return Dive(Observations(point, view, noisy, z, xy, positions), beta, B_inf)


def _scene(random: np.random.Generator) -> tuple[Array, Array]:
    """Positions [P, 3] and colours [P, 3]; neighbours are of one patch."""
    positions = np.zeros((POINTS, 3))
    positions[:, :2] = random.uniform(-1.0, 1.0, (POINTS, 2)) * (3.0, 1.0)
    brightness = 0.3 * np.exp(0.45 * random.normal(size=(PATCHES, 1)))
    tint = np.exp(0.2 * random.normal(size=(PATCHES, 3)))
    texture = np.exp(0.45 * random.normal(size=(POINTS, 1)))
    return positions, (brightness * tint)[_patch_of(positions)] * texture


def _patch_of(positions: Array) -> npt.NDArray[np.int64]:
    """[P] number of the patch: a grid of 10 by 3 over the ground."""
    column = np.clip((positions[:, 0] + 3.0) / 0.6, 0, 9).astype(np.int64)
    return column * 3 + np.clip((positions[:, 1] + 1.0) / 0.667, 0, 2).astype(np.int64)


def _water(random: np.random.Generator) -> Array:
    """[3, 3]: beta_a, b and B_inf of a water between two of Jerlov's types, more or less thick."""
    one, other = (WATER_TYPES[name] for name in random.choice(DRAWN, 2, replace=False))  # type: ignore[index]
    share = random.uniform()
    beta, B_inf = (
        (1.0 - share) * np.array(getattr(one, name)) + share * np.array(getattr(other, name))
        for name in ("beta_a", "B_inf")
    )
    beta *= 0.7 * np.exp(0.5 * random.normal()) / beta[0]
    white_balance = np.exp(0.3 * random.normal(size=3))
    b = beta * np.exp(0.3 * random.normal(size=3))
    return np.stack([beta, b, np.minimum(B_inf * white_balance, 0.95)])
