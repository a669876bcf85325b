"""Objects that were placed on a synthetic sea floor, and patches of it that bleached."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from aquaflow.lab.synthetic.config import Bleached, PlantedObject
from aquaflow.lab.synthetic.noise import FloatMap
from aquaflow.lab.synthetic.objects import Solid
from aquaflow.lab.synthetic.relief import Area, Relief

SUNK = 0.2
"""Share of an object's half height that is in the floor, which is uneven."""
EDGE = 0.15
"""Share of a patch's radius over which it fades."""
WHITE, PALE = 1.7, 0.85
"""Brightness of a bleached coral over its own, and the most that it becomes: tissue without algae
shows the white skeleton (judgement, from pictures of bleached Acropora)."""


def placed_shapes(placed: Sequence[PlantedObject], relief: Relief) -> list[Solid]:
    """The objects, standing on the relief."""
    return [_shape(each, relief) for each in placed]


def _shape(placed: PlantedObject, relief: Relief) -> Solid:
    x, y = placed.at_m
    ground = float(relief.area.sample(relief.height, np.array([[x, y]]))[0])
    c, s = (f(math.radians(placed.turn_deg)) for f in (math.cos, math.sin))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    centre = np.array([x, y, ground + (1.0 - SUNK) * placed.half_m])
    growth = (0.26, 0.24, 0.15)
    kind: Literal["box", "sphere"] = "box" if placed.kind == "box" else "sphere"
    size = (placed.half_m,) * 3
    return Solid(
        kind, centre, R, size, placed.paint, growth, 0.35, pattern_m=placed.pattern_m
    )  # fmt: skip


def bleach(
    floor: FloatMap,  # [rows, columns, 4] radiance and steepness
    area: Area,
    patches: Sequence[Bleached],
) -> None:
    """Make patches of the floor lighter and less saturated, in place."""
    rows, columns = floor.shape[:2]
    x = area.x0 + (np.arange(columns) + 0.5) * (area.cell * area.shape[1] / columns)
    y = area.y0 + (np.arange(rows) + 0.5) * (area.cell * area.shape[0] / rows)
    for patch in patches:
        away = np.hypot(x[None, :] - patch.at_m[0], y[:, None] - patch.at_m[1]) / patch.radius_m
        weight = patch.share * np.clip((1.0 - away) / EDGE, 0.0, 1.0)
        colour = floor[..., :3]
        grey = np.minimum(WHITE * colour.mean(axis=-1, keepdims=True) + 0.1, PALE)
        colour += (weight[..., None] * (grey - colour)).astype(np.float32)
