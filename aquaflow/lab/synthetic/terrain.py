"""The shapes of the sea floor: base relief, rock, and the stamps of each scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aquaflow.lab.synthetic import hull, placement, stamps
from aquaflow.lab.synthetic.config import SceneKind
from aquaflow.lab.synthetic.noise import FloatMap, fractal, smoothstep
from aquaflow.lab.synthetic.relief import Area, Array, Relief


def build_relief(
    kind: SceneKind,
    area: Area,
    loop: Array,  # [N, 2] m, the vehicle's path, kept clear of tall objects
    rng: np.random.Generator,
) -> Relief:
    """The relief of one scene."""
    base = _BASES[kind](rng, area)
    relief = Relief(
        area, base, np.full((*area.shape, 3), 0.4, np.float32), np.zeros(area.shape, np.float32)
    )
    plan = _PLANS[kind]
    rough = fractal(rng, area.shape, area.cell, 0.5, 0.03, 0.15)
    if plan.rock_cover > 0.0:
        patch = fractal(rng, area.shape, area.cell, 3.0, 0.1, 0.3)
        relief.cover[:] = smoothstep(patch, plan.rock_level - 0.25, plan.rock_level + 0.25)
        relief.cover *= np.float32(plan.rock_cover)
        relief.height += relief.cover * (0.10 + 0.03 * rough)
        stone = np.array([0.50, 0.45, 0.38], np.float32)
        relief.tint[:] = stone * (1.0 + 0.12 * rough[..., None])
    clear = cKDTree(loop)
    for maker, per_m2 in plan.stamps:
        count = rng.poisson(per_m2 * area.cell**2 * area.shape[0] * area.shape[1])
        stamps.scatter(relief, maker, int(count), rng, rough, clear)
    return relief


def _reef(rng: np.random.Generator, area: Area) -> FloatMap:
    hills = fractal(rng, area.shape, area.cell, 4.5, 0.3, 0.15)
    ridges = 1.0 - np.abs(fractal(rng, area.shape, area.cell, 2.4, 0.1, 0.2))
    fine = fractal(rng, area.shape, area.cell, 0.6, 0.03, 0.2)
    return np.asarray(0.14 * hills + 0.10 * ridges + 0.015 * fine, np.float32)


def _sand(rng: np.random.Generator, area: Area) -> FloatMap:
    """Ripples whose crests wander and fork, on low dunes."""
    rows, columns = area.shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32) * np.float32(area.cell)
    bend = fractal(rng, area.shape, area.cell, 2.5, 0.3, 0.2)
    strength = smoothstep(fractal(rng, area.shape, area.cell, 3.0, 0.5, 0.2), -1.2, 0.6)
    phase = 2.0 * math.pi * ((0.93 * x + 0.36 * y) / 0.17 + 0.9 * bend)
    # A ripple's crest is sharper than its trough.
    ripple = 1.0 - 2.0 * np.abs(np.sin(0.5 * phase)) ** 0.8
    dunes = fractal(rng, area.shape, area.cell, 5.0, 0.6, 0.1)
    fine = fractal(rng, area.shape, area.cell, 0.3, 0.02, 0.3)
    return np.asarray(0.05 * dunes + 0.011 * strength * ripple + 0.003 * fine, np.float32)


def _wall(rng: np.random.Generator, area: Area) -> FloatMap:
    """Ledges across the climb, on rough rock."""
    hills = fractal(rng, area.shape, area.cell, 3.5, 0.3, 0.2)
    x = np.arange(area.shape[1], dtype=np.float32) * np.float32(area.cell)
    bedding = x[None, :] / 0.8 + 0.5 * fractal(rng, area.shape, area.cell, 3.0, 0.2, 0.3)
    step = bedding - np.floor(bedding)
    ledge = np.where(step < 0.85, step / 0.85, (1.0 - step) / 0.15)
    fine = fractal(rng, area.shape, area.cell, 0.7, 0.03, 0.25)
    return np.asarray(0.15 * hills + 0.16 * ledge + 0.025 * fine, np.float32)


@dataclass(frozen=True)
class _TerrainPlan:
    rock_cover: float
    rock_level: float
    """Threshold, in sigmas of the patch noise, above which there is rock."""
    stamps: tuple[tuple[stamps.Maker, float], ...]
    """What is scattered, and how many per square metre."""


def _bedding(rng: np.random.Generator, area: Area) -> FloatMap:
    """Flat, just below the tiles of a pool."""
    return np.full(area.shape, -0.01, np.float32)


def _open_water(rng: np.random.Generator, area: Area) -> FloatMap:
    """Nothing solid behind a net, as far as can be seen."""
    return np.full(area.shape, -placement.BEHIND_M, np.float32)


_BASES = {
    "reef": _reef, "flat_sand": _sand, "wall": _wall, "pipe": _sand, "pool": _bedding,
    "survey": _reef, "hull": hull.plated_side, "net": _open_water,
}  # fmt: skip
"""Large shapes of each scene."""
_REEF = _TerrainPlan(
    1.0,
    -0.1,
    (
        (stamps.boulder, 0.9),
        (stamps.brain_coral, 0.45),
        (stamps.table_coral, 0.2),
        (stamps.branching_coral, 0.6),
        (stamps.sponge, 0.4),
        (stamps.pebble, 10.0),
    ),
)
"""Rock in patches, with what grows on it."""
_PLANS = {
    "reef": _REEF,
    "survey": _REEF,
    "pool": _TerrainPlan(0.0, 0.0, ()),
    "hull": _TerrainPlan(0.0, 0.0, ()),
    "net": _TerrainPlan(0.0, 0.0, ()),
    "flat_sand": _TerrainPlan(0.0, 0.0, ((stamps.boulder, 0.03), (stamps.pebble, 6.0))),
    "wall": _TerrainPlan(
        1.0,
        -3.0,
        (
            (stamps.boulder, 0.6),
            (stamps.brain_coral, 0.3),
            (stamps.branching_coral, 0.8),
            (stamps.sponge, 1.2),
        ),
    ),
    "pipe": _TerrainPlan(
        0.0, 0.0, ((stamps.boulder, 0.12), (stamps.sponge, 0.1), (stamps.pebble, 7.0))
    ),
}
"""What lies on the large shapes of each scene."""
