"""A ship's side: painted plates of one size with weld seams between them, on a curved hull."""

from __future__ import annotations

import numpy as np

from aquaflow.lab.synthetic.noise import FloatMap, fractal, smoothstep
from aquaflow.lab.synthetic.relief import Area

PLATE_M = (0.75, 1.5)
"""Height and length of a plate; the seams run through."""
BEAD_M = 0.012
"""Half width of a weld's bead."""
BEAD_HEIGHT_M = 0.006
"""Of the bead above the plates."""
RADIUS_M = 9.0
"""Of the hull's curvature, about a horizontal axis."""
DENT_M = 0.004
"""Standard deviation of the plates' dents between frames: light on them is nearly even."""
PAINT, SLIME = (0.55, 0.30, 0.24), (0.36, 0.40, 0.24)
BARNACLE, SEAM = (0.75, 0.72, 0.64), (0.16, 0.10, 0.09)
"""Albedo, RGB, of antifouling paint, of what grows on it, and of a seam."""


def plated_side(rng: np.random.Generator, area: Area) -> FloatMap:
    """Height [H, W] (m) towards the camera; the survey frame's x is up the side."""
    x, _ = _positions(area.shape, area.cell, area)
    middle = 0.5 * (float(x[0, 0]) + float(x[0, -1]))
    curved = -((x - middle) ** 2) / (2.0 * RADIUS_M)
    dents = fractal(rng, area.shape, area.cell, 1.0, 0.3, 0.2)
    bead = _seams(area.shape, area.cell, area)
    return np.asarray(curved + DENT_M * dents + BEAD_HEIGHT_M * bead, np.float32)


def painted_plates(
    area: Area, shape: tuple[int, int], texel: float, rng: np.random.Generator
) -> FloatMap:
    """Albedo [*shape, 3]: even paint, slime in streaks, few barnacles, bare seams."""
    grain = fractal(rng, shape, texel, 0.1, 0.0, 0.8)
    streaks = fractal(rng, shape, texel, 1.2, 0.0, 0.5)
    spots = fractal(rng, shape, texel, 0.08, 0.0, 0.8)
    paint = np.asarray(PAINT, np.float32) * (1.0 + 0.04 * grain)[..., None]
    _mix(paint, 0.6 * smoothstep(streaks, 0.6, 1.8), SLIME)
    _mix(paint, 0.8 * smoothstep(spots, 2.6, 3.0), BARNACLE)
    _mix(paint, 0.9 * _seams(shape, texel, area), SEAM)
    return paint


def _mix(
    colour: FloatMap,  # [H, W, 3], changed in place
    weight: FloatMap,  # [H, W]
    other: tuple[float, float, float],
) -> None:
    colour += weight[..., None] * (np.asarray(other, np.float32) - colour)


def _positions(shape: tuple[int, int], cell: float, area: Area) -> tuple[FloatMap, FloatMap]:
    """x [1, W] and y [H, 1] (m, survey frame) of the cells' centres."""
    rows, columns = shape
    x = area.x0 + (np.arange(columns, dtype=np.float32) + 0.5) * np.float32(cell)
    y = area.y0 + (np.arange(rows, dtype=np.float32) + 0.5) * np.float32(cell)
    return np.asarray(x[None], np.float32), np.asarray(y[:, None], np.float32)


def _seams(shape: tuple[int, int], cell: float, area: Area) -> FloatMap:
    """[H, W] 1 on a seam, 0 a bead's half width beside it."""
    x, y = _positions(shape, cell, area)
    half = np.float32(max(BEAD_M, cell))
    across, along = (
        np.abs(np.remainder(v / size + 0.5, 1.0) - 0.5) * size
        for v, size in ((x, PLATE_M[0]), (y, PLATE_M[1]))
    )
    nearest = np.minimum(across, along)
    return np.asarray(np.clip(1.0 - nearest / half, 0.0, 1.0), np.float32)
